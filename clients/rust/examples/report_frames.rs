//! Reports a car ten times a second, as seen by a camera at a pose.

use std::thread::sleep;
use std::time::{Duration, SystemTime};

use ecod_client::{Cell, Frame, PerceivedObject, Settings, WirePose};

fn main() -> Result<(), ecod_client::Error> {
    let names = Settings {
        cell: "lot-1".into(),
        node: "euclid".into(),
        part: "lidar".into(),
        ..Settings::default()
    };
    let cell = Cell::connect(names)?;
    loop {
        let captured_at = SystemTime::now();
        let car = PerceivedObject {
            covariance_m2: Some([0.04, 0.0, 0.04]),
            ..PerceivedObject::new("car", 0.93, 12.4, -3.1)
        };
        let pose = Some(WirePose::new(1.0, 6.0, -1.57));
        cell.report(Frame {
            captured_at,
            pose,
            ..Frame::new(vec![car])
        })?;
        sleep(Duration::from_millis(100));
    }
}
