//! Reads maps, and reports a car with each.

use ecod_client::{Cell, Frame, PerceivedObject, Settings};

fn main() -> Result<(), ecod_client::Error> {
    let names = Settings {
        cell: "lot-1".into(),
        node: "euclid".into(),
        part: "lidar".into(),
        ..Settings::default()
    };
    let cell = Cell::connect(names)?;
    for map in cell.maps() {
        println!("{}", map?.round);
        let car = PerceivedObject::new("car", 0.93, 12.4, -3.1);
        cell.report(Frame {
            seen: Some(vec!["slot-0".into()]),
            ..Frame::new(vec![car])
        })?;
    }
    Ok(())
}
