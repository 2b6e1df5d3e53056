//! Brakes for objects that the cell sees ahead, including around corners; it also brakes without
//! maps.
//!
//! `cargo run -p ecod-client --example brake_planner -- X_M Y_M HEADING_DEG SPEED_MPS`
//!
//! The heading is counter-clockwise from east; `--azimuth DEG` in its place is clockwise from north.
//!
//! A real planner takes pose and speed from its localisation; here they are given. It prints a line
//! when the decision changes. The cell is set by `ECOD_BROKER`, `ECOD_CELL` and `ECOD_NAME`.

use std::time::Duration;

use ecod_client::{Cell, Error, GlobalMap, NodeName, Settings, WirePose, now};

/// Half the width in metres that the vehicle needs.
const HALF_WIDTH_M: f64 = 1.5;

/// Longest time that a map may be missing.
const MISSING: Duration = Duration::from_millis(500);

/// Time in seconds until the brakes act, and how they act in m/s².
const REACTION_S: f64 = 0.5;
const DECELERATION_MPS2: f64 = 4.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |text: &String| text.parse::<f64>();
    let (pose, speed_mps) = match &arguments[..] {
        [x, y, flag, azimuth, speed] if flag == "--azimuth" => {
            let pose = WirePose::from_compass(number(x)?, number(y)?, number(azimuth)?)?;
            (pose, number(speed)?)
        }
        [x, y, heading, speed] => {
            let pose = WirePose::new(number(x)?, number(y)?, number(heading)?.to_radians());
            (pose, number(speed)?)
        }
        _ => return Err("usage: brake_planner X_M Y_M HEADING_DEG|--azimuth DEG SPEED_MPS".into()),
    };
    let stopping_m = speed_mps * REACTION_S + speed_mps.powi(2) / (2.0 * DECELERATION_MPS2);
    let cell = Cell::connect(Settings {
        part: "planner".into(),
        ..Settings::default()
    })?;
    let mut said = "";
    for map in cell.maps().timeout(MISSING) {
        let (decision, reason) = match map {
            Ok(map) => match distance_ahead(&map, &cell.name().vehicle(), pose) {
                Some(distance_m) if distance_m < stopping_m => {
                    ("BRAKE", format!("an object is {distance_m:.1} m ahead"))
                }
                _ => ("GO", "nothing is in the way".to_owned()),
            },
            Err(Error::Silent(_)) => ("BRAKE", format!("no map for {MISSING:?}")),
            Err(error) => return Err(error.into()),
        };
        if decision != said {
            println!("{decision}: {reason}");
            said = decision;
        }
    }
    Ok(())
}

/// Distance in metres along the heading to the nearest object in the way, moved on by the map's age.
fn distance_ahead(map: &GlobalMap, own: &NodeName, pose: WirePose) -> Option<f64> {
    let age_s = now().since(map.fused_at_us).min(MISSING).as_secs_f64();
    let (sin, cos) = pose.heading_rad.sin_cos();
    // Vehicles that report their pose are in the map, this one too, maybe by a part of it: `euclid--lidar`.
    let others = map
        .objects
        .iter()
        .filter(|object| object.vehicle.as_ref().map(NodeName::vehicle).as_ref() != Some(own));
    let ahead = others.filter_map(|object| {
        let [east, north] = object.velocity_mps.unwrap_or_default();
        let dx = object.x_m + age_s * east - pose.x_m;
        let dy = object.y_m + age_s * north - pose.y_m;
        let along = dx * cos + dy * sin;
        let aside = dy * cos - dx * sin;
        let width_m = object.size_m.map_or(0.0, |[_, width]| width);
        (along > 0.0 && aside.abs() <= HALF_WIDTH_M + width_m / 2.0).then_some(along)
    });
    ahead.reduce(f64::min)
}
