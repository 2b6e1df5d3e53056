//! MOTChallenge (Leal-Taixé et al., arXiv 1504.01942), `det.txt` and `gt.txt`, with positions on the ground.
//!
//! Separated by commas: frame from 1 on, track or −1, box in the image (4), score, x, y, z in metres. Truth of score 0
//! counts nowhere. Files without positions on the ground, all −1 or with fewer columns, cannot be judged by distance.

use ecod::model::names::Label;
use nalgebra::Point2;

use super::{Cells, FileObject, LineError};

pub(super) fn object(cells: &Cells) -> Result<Option<(u64, FileObject)>, LineError> {
    let frame = cells.frame()?;
    let id = Some(cells.integer(2, "track")?).filter(|id| *id >= 0);
    let score = cells.number(7, "score")?;
    if cells.cells.len() < 10 {
        let fault = format!("is no position on the ground, there are {} columns", cells.cells.len());
        return Err(cells.error(8, "x", fault));
    }
    let position = Point2::new(cells.number(8, "x")?, cells.number(9, "y")?);
    if position == Point2::new(-1.0, -1.0) {
        return Err(cells.error(8, "x", "-1 is no position on the ground".into()));
    }
    let is_ignored = id.is_some() && score == 0.0;
    let object = FileObject { id, label: Label::new_static("person"), score, position };
    Ok((!is_ignored).then_some((frame, object)))
}
