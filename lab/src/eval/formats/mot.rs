//! MOTChallenge (Leal-Taixé et al., arXiv 1504.01942), `det.txt` and `gt.txt`.
//!
//! Separated by commas: frame from 1 on, track or −1, box in the image (4), score, x, y, z in
//! metres. Truth of score 0 is ignored. Files with image positions only have no x and y, or −1.

use ecod::model::detection::BoundingBox;
use ecod::model::names::Label;
use nalgebra::Point2;

use super::{Cells, FilePlace, LineError, ParsedObject};

/// Width and height in the image count from the left upper corner.
pub(super) fn object(
    cells: &Cells,
    has_camera: bool,
) -> Result<Option<(u64, ParsedObject)>, LineError> {
    let frame = cells.frame()?;
    if frame == 0 {
        return Err(cells.error(
            1,
            "frame",
            "0 is out of bounds, the first frame is 1".into(),
        ));
    }
    if !cells.has_commas {
        return Err(cells.error(
            1,
            "frame",
            "is not followed by a comma; files of MOTChallenge have commas".into(),
        ));
    }
    let id = Some(cells.integer(2, "track")?).filter(|id| *id >= 0);
    let score = cells.number(7, "score")?;
    let place = match ground(cells)? {
        Some(position) => FilePlace::Ground(position),
        None if has_camera => FilePlace::Image(image(cells)?),
        None => {
            let fault =
                "is no position on the ground: give the camera of the boxes with --config".into();
            return Err(cells.error(8, "x", fault));
        }
    };
    let is_ignored = id.is_some() && score == 0.0;
    let object = ParsedObject {
        entry: cells.line,
        id,
        label: Label::new_static("person"),
        score,
        place,
    };
    Ok((!is_ignored).then_some((frame, object)))
}

fn ground(cells: &Cells) -> Result<Option<Point2<f64>>, LineError> {
    if cells.cells.len() < 10 {
        return Ok(None);
    }
    let position = Point2::new(cells.number(8, "x")?, cells.number(9, "y")?);
    Ok((position != Point2::new(-1.0, -1.0)).then_some(position))
}

fn image(cells: &Cells) -> Result<BoundingBox, LineError> {
    let x_min = cells.number(3, "left")?;
    let y_min = cells.number(4, "top")?;
    Ok(BoundingBox {
        x_min,
        y_min,
        x_max: x_min + cells.number(5, "width")?,
        y_max: y_min + cells.number(6, "height")?,
    })
}
