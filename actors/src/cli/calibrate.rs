//! `ecod-node calibrate`: a calibration file from photographs of a chessboard.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::{Failure, print};
use crate::camera::calibrate::{Chessboard, calibrate, photographs};

/// Flags of `calibrate`.
#[derive(Debug, Args)]
pub(super) struct CalibrateArguments {
    /// Inner corners along a row of the board: squares minus one
    #[arg(long, default_value_t = 9)]
    columns: u16,
    /// Inner corners along a column of the board: squares minus one
    #[arg(long, default_value_t = 6)]
    rows: u16,
    /// Side of a square in millimetres
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// Calibration file to write
    #[arg(long, value_name = "FILE", default_value = "calibration.toml")]
    out: PathBuf,
    /// Photographs, or directories of photographs
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
}

pub(super) fn run(arguments: &CalibrateArguments) -> Result<(), Failure> {
    let CalibrateArguments { columns, rows, square_mm, out, images } = arguments;
    let board = Chessboard { columns: *columns, rows: *rows, square_mm: *square_mm };
    let images = photographs(images).map_err(Failure::usage)?;
    let report = calibrate(&images, &board).context("cannot calibrate")?;
    for image in &report.without_board {
        eprintln!("the whole board was not found in {}", image.display());
    }
    let found = &report.calibration;
    found.write(out).context("cannot calibrate")?;
    let (out, rms_px, photographs) = (out.display(), found.rms_px, found.images.len());
    Ok(print(&format!("{out}: {rms_px:.3} px rms over {photographs} photographs\n"))?)
}
