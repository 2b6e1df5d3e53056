//! Errors that the estimates of one distance share.

use nalgebra::SVector;

/// Sources of errors that the estimates of one box have in common.
#[derive(Debug, Clone, Copy)]
pub(super) enum Source {
    FootRow,
    HeadRow,
    Pitch,
    Roll,
    CameraHeight,
    ObjectHeight,
    Depth,
}

/// Changes by an error of one standard deviation of each [`Source`], to first order.
pub(super) type Errors = SVector<f64, 7>;
