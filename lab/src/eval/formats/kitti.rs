//! KITTI tracking (Geiger, Lenz, Urtasun, CVPR 2012): labels and results, and detections as AB3DMOT
//! keeps them.
//!
//! Labels, separated by blanks: frame, track, type, truncated, occluded, alpha, box in the image
//! (4), height, width, length, x, y, z, rotation, and a score in results. Detections, separated by
//! commas: frame, number of the type, box in the image (4), score, height, width, length, x, y, z,
//! rotation, alpha.
//!
//! Positions are in the frame of the left camera, x right and z forward. Here x is forward and y
//! left.

use ecod::model::names::Label;
use nalgebra::Point2;

use super::{Cells, FilePlace, LineError, ParsedObject};

/// The classes that the benchmark evaluates. Others, such as vans, are left out.
const CLASSES: [&str; 3] = ["Pedestrian", "Car", "Cyclist"];

pub(super) fn object(cells: &Cells) -> Result<Option<(u64, ParsedObject)>, LineError> {
    let frame = cells.frame()?;
    let place = |x: usize| {
        Ok(FilePlace::Ground(Point2::new(
            cells.number(x + 2, "z")?,
            -cells.number(x, "x")?,
        )))
    };
    if cells.has_commas {
        let number = cells.integer(2, "type")?;
        let class = usize::try_from(number - 1)
            .ok()
            .and_then(|place| CLASSES.get(place));
        let unknown = || {
            cells.error(
                2,
                "type",
                format!("{number} is none of 1 to {}", CLASSES.len()),
            )
        };
        let label = Label::new_static(class.ok_or_else(unknown)?);
        let score = cells.number(7, "score")?;
        return Ok(Some((
            frame,
            ParsedObject {
                entry: cells.line,
                id: None,
                label,
                score,
                place: place(11)?,
            },
        )));
    }
    let id = Some(cells.integer(2, "track")?).filter(|id| *id >= 0);
    let class = cells.text(3, "type")?;
    let Some(label) = CLASSES.into_iter().find(|known| *known == class) else {
        return Ok(None);
    };
    let has_score = cells.cells.len() > 17;
    let score = if has_score {
        cells.number(18, "score")?
    } else {
        1.0
    };
    Ok(Some((
        frame,
        ParsedObject {
            entry: cells.line,
            id,
            label: Label::new_static(label),
            score,
            place: place(14)?,
        },
    )))
}
