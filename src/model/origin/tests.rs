//! Positions on Earth against PROJ 9.5.1, headings against directions on the ground.

use proptest::prelude::*;

use super::*;

/// One centimetre and less.
const TOLERANCE_M: f64 = 1e-4;

/// Origins, positions in the frame, and these positions as latitude, longitude and height by PROJ:
/// `+proj=pipeline +step +inv +proj=topocentric +lat_0=… +lon_0=… +h_0=… +step +inv +proj=cart`,
/// ellipsoid WGS84.
const BY_PROJ: [([f64; 3], [f64; 3], [f64; 3]); 20] = [
    (
        [52.2296756, 21.0122287, 113.0],
        [5000.0, 0.0, 0.0],
        [52.22965291767, 21.08540596582, 114.95568],
    ),
    (
        [52.2296756, 21.0122287, 113.0],
        [-3535.5, 3535.5, -1.96],
        [52.26143717743, 20.96044806058, 112.99811],
    ),
    (
        [52.2296756, 21.0122287, 113.0],
        [12.4, -3.1, 0.0],
        [52.22964774062, 21.01241017960, 113.00001],
    ),
    (
        [52.2296756, 21.0122287, 113.0],
        [-1233.2, -2444.1, 15.09],
        [52.20770947135, 20.99418919507, 128.67745],
    ),
    (
        [-33.8688, 151.2093, 58.0],
        [5000.0, 0.0, 0.0],
        [-33.86878815360, 151.26333802068, 59.95776],
    ),
    (
        [-33.8688, 151.2093, 58.0],
        [-3535.5, 3535.5, -1.96],
        [-33.83691996725, 151.17110389400, 58.00228],
    ),
    (
        [-33.8688, 151.2093, 58.0],
        [12.4, -3.1, 0.0],
        [-33.86882794774, 151.20943401437, 58.00001],
    ),
    (
        [-33.8688, 151.2093, 58.0],
        [-2992.9, 251.2, -13.43],
        [-33.86653107637, 151.17695470151, 45.27643],
    ),
    (
        [0.0, 0.0, 0.0],
        [5000.0, 0.0, 0.0],
        [0.00000000000, 0.04491575501, 1.95982],
    ),
    (
        [0.0, 0.0, 0.0],
        [-3535.5, 3535.5, -1.96],
        [0.03197398446, -0.03175994338, 0.00639],
    ),
    (
        [0.0, 0.0, 0.0],
        [12.4, -3.1, 0.0],
        [-0.00002803545, 0.00011139110, 0.00001],
    ),
    (
        [0.0, 0.0, 0.0],
        [-3094.0, 52.1, -46.25],
        [0.00047117988, -0.02779407425, -45.49934],
    ),
    (
        [78.2, 15.6, -30.0],
        [5000.0, 0.0, 0.0],
        [78.19991624439, 15.81893562022, -28.04647],
    ),
    (
        [78.2, 15.6, -30.0],
        [-3535.5, 3535.5, -1.96],
        [78.23162496112, 15.44477966657, -30.00623],
    ),
    (
        [78.2, 15.6, -30.0],
        [12.4, -3.1, 0.0],
        [78.19997223321, 15.60054296172, -29.99999],
    ),
    (
        [78.2, 15.6, -30.0],
        [-464.5, -3011.0, -40.93],
        [78.17302997337, 15.57970636389, -70.20450],
    ),
    (
        [37.4, -179.99, 2500.0],
        [5000.0, 0.0, 0.0],
        [37.39998652640, -179.93355252608, 2501.95663],
    ),
    (
        [37.4, -179.99, 2500.0],
        [-3535.5, 3535.5, -1.96],
        [37.43183626920, 179.97006907704, 2500.00075],
    ),
    (
        [37.4, -179.99, 2500.0],
        [12.4, -3.1, 0.0],
        [37.39997207923, -179.98986001027, 2500.00001],
    ),
    (
        [37.4, -179.99, 2500.0],
        [-528.4, 2288.0, -37.62],
        [37.42060720261, -179.99596703999, 2462.81331],
    ),
];

fn at(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> GeographicOrigin {
    GeographicOrigin {
        latitude_deg,
        longitude_deg,
        height_m,
        rotation_deg: 0.0,
    }
}

fn position([latitude_deg, longitude_deg, height_m]: [f64; 3]) -> GeographicPosition {
    GeographicPosition {
        latitude_deg,
        longitude_deg,
        height_m,
    }
}

fn pose(latitude_deg: f64, longitude_deg: f64, azimuth_deg: f64) -> GeographicPose {
    GeographicPose {
        latitude_deg,
        longitude_deg,
        height_m: None,
        azimuth_deg,
    }
}

/// Distance of two positions on Earth in metres.
fn apart_m(one: &GeographicPosition, other: &GeographicPosition) -> f64 {
    at(other.latitude_deg, other.longitude_deg, other.height_m)
        .to_map(one)
        .coords
        .norm()
}

#[test]
fn positions_match_proj() {
    for ([latitude, longitude, height], [x, y, z], by_proj) in BY_PROJ {
        let origin = at(latitude, longitude, height);
        let by_proj = position(by_proj);
        let there = origin.to_wgs84(x, y, z);
        // The longest degree, so that a point that is near in degrees is also near in metres.
        let degree_m = 111_700.0;
        let off = [
            (there.latitude_deg - by_proj.latitude_deg) * degree_m,
            (there.longitude_deg - by_proj.longitude_deg) * degree_m,
            there.height_m - by_proj.height_m,
        ];
        assert!(
            off.iter().all(|off| off.abs() < TOLERANCE_M),
            "{there:?} is {by_proj:?}"
        );
        let back = origin.to_map(&by_proj);
        assert!(
            (back - Point3::new(x, y, z)).norm() < TOLERANCE_M,
            "{back} is {x}, {y}, {z}"
        );
    }
}

#[test]
fn curvature_keeps_ground_distances() {
    let origin = at(52.2296756, 21.0122287, 0.0);
    // 5 km along a geodesic to the north-east, by PROJ.
    let on_ground = position([52.26143804141, 21.06401074718, 0.0]);
    let there = origin.to_map(&on_ground);
    assert!((there.xy().coords.norm() - 5000.0).abs() < 0.001, "{there}");
    assert!((there.z + 1.958).abs() < 0.001, "{there}");
    // Without its height, an object on the ground is where it is to 2 mm, and too high.
    let flat = origin.to_wgs84(there.x, there.y, 0.0);
    assert!((flat.height_m - 1.958).abs() < 0.001, "{flat:?}");
    assert!(
        apart_m(
            &GeographicPosition {
                height_m: 0.0,
                ..flat
            },
            &on_ground
        ) < 0.002
    );
}

#[test]
fn heading_is_clockwise_from_local_north() {
    let origin = at(52.2, 21.0, 100.0);
    let error = origin.pose_to_map(&pose(52.2, 21.0, 450.0)).unwrap_err();
    assert_eq!(error, PoseError::Azimuth { azimuth_deg: 450.0 });
    for (azimuth_deg, heading_deg) in [
        (0.0, 90.0),
        (90.0, 0.0),
        (180.0, -90.0),
        (270.0, 180.0),
        (-45.0, 135.0),
    ] {
        let here = origin.pose_to_map(&pose(52.2, 21.0, azimuth_deg)).unwrap();
        assert!(here.position.coords.norm() < 1e-6);
        assert!(
            wrap_angle(here.heading_rad - f64::to_radians(heading_deg)).abs() < 1e-9,
            "{here:?}"
        );
        let turned = GeographicOrigin {
            rotation_deg: 30.0,
            ..origin
        };
        let turned = turned.pose_to_map(&pose(52.2, 21.0, azimuth_deg)).unwrap();
        assert!(
            wrap_angle(turned.heading_rad - f64::to_radians(heading_deg - 30.0)).abs() < 1e-9,
            "{turned:?}"
        );
    }
    // 68 km to the east, north is 0.8° off; a compass course there corresponds to this heading in
    // the map.
    let there = origin.pose_to_map(&pose(52.2, 22.0, 0.0)).unwrap();
    let ahead = origin.pose_to_map(&pose(52.2001, 22.0, 0.0)).unwrap();
    let driven = ahead.position - there.position;
    assert!(
        (driven.y.atan2(driven.x) - there.heading_rad).abs() < 1e-5,
        "{there:?}, {driven}"
    );
    assert!(
        (there.heading_rad.to_degrees() - 90.79).abs() < 0.01,
        "{there:?}"
    );
}

#[test]
fn missing_height_uses_origin_height() {
    let origin = at(46.5, 8.0, 2000.0);
    let stated = pose(46.54, 8.0, 0.0);
    let level = origin.pose_to_map(&stated).unwrap();
    let of_height = |height_m| {
        origin
            .pose_to_map(&GeographicPose {
                height_m: Some(height_m),
                ..stated
            })
            .unwrap()
    };
    assert_eq!(level, of_height(2000.0));
    let higher_m = (of_height(2010.0).position - level.position).norm();
    assert!(
        (0.005..0.008).contains(&higher_m),
        "10 m of height at 4.4 km: {higher_m}"
    );
}

#[test]
fn earth_pose_needs_near_origin() {
    let warsaw = at(52.2296756, 21.0122287, 113.0);
    let in_map = StatedPose::InMap(Pose::new(1.0, 2.0, 3.0));
    assert_eq!(
        in_map.in_map(None),
        Ok(Pose::new(1.0, 2.0, 3.0)),
        "metres need none"
    );
    let berlin = StatedPose::OnEarth(pose(52.52, 13.4, 0.0));
    assert_eq!(berlin.in_map(None), Err(PoseError::NoOrigin));
    let error = berlin.in_map(Some(&warsaw)).unwrap_err().to_string();
    assert!(
        error.contains("519 km from the cell's origin, at most 100")
            && error.contains("`[origin]`"),
        "{error}"
    );
    // On the other side of Earth, x and y alone would be near.
    let antipode = StatedPose::OnEarth(pose(-52.2296756, -158.9877713, 0.0));
    assert!(
        matches!(antipode.in_map(Some(&warsaw)), Err(PoseError::TooFar { distance_m }) if distance_m > 1e7)
    );
}

proptest! {
    /// Anywhere, also at the poles and the date line.
    #[test]
    fn conversion_round_trips(
        (latitude, longitude, height) in (-90.0..=90.0, -180.0..=180.0, -400.0..9000.0),
        (rotation_deg, x, y, z) in (-360.0..360.0, -1e5..1e5, -1e5..1e5, -500.0..500.0),
    ) {
        let origin = GeographicOrigin { rotation_deg, ..at(latitude, longitude, height) };
        let there = origin.to_wgs84(x, y, z);
        prop_assert!(there.latitude_deg.abs() <= 90.0 && there.longitude_deg.abs() <= 180.0);
        prop_assert!((origin.to_map(&there) - Point3::new(x, y, z)).norm() < TOLERANCE_M);
    }
}

#[test]
fn compass_heading_uses_true_north() {
    let south = StatedPose::ByCompass(Point2::new(1.0, 6.0), 180.0);
    let rotated = GeographicOrigin {
        rotation_deg: 30.0,
        ..at(52.2296756, 21.0122287, 113.0)
    };
    for (origin, heading_deg) in [(None, -90.0f64), (Some(&rotated), -120.0)] {
        let pose = south.in_map(origin).unwrap();
        assert!(
            (pose.heading_rad - heading_deg.to_radians()).abs() < 1e-12,
            "{pose:?}"
        );
        assert_eq!(pose.position, Point2::new(1.0, 6.0));
    }
}
