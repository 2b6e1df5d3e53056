//! `ecod-node calibrate`: a calibration file from photographs of a chessboard, and the mount of a
//! camera.

mod mount;

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, Subcommand};

use super::{Failure, print};
use crate::camera::calibrate::{Chessboard, calibrate, photographs};

/// Flags of `calibrate`.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(super) struct CalibrateArguments {
    #[command(subcommand)]
    part: Option<CalibrateCommand>,
    #[command(flatten)]
    board: BoardArguments,
    /// Calibration file to write
    #[arg(
        short,
        long,
        alias = "out",
        value_name = "FILE",
        default_value = "calibration.toml"
    )]
    output: PathBuf,
    /// Photographs, or directories of photographs
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Find height and tilt of a camera: from points on the ground, a board that lies there, or
    /// people who walk
    #[command(subcommand)]
    Mount(mount::MountCommand),
}

/// Flags of a printed chessboard.
#[derive(Debug, Args)]
struct BoardArguments {
    /// Inner corners along a row of the board: squares minus one
    #[arg(long, default_value_t = 9)]
    columns: u16,
    /// Inner corners along a column of the board: squares minus one
    #[arg(long, default_value_t = 6)]
    rows: u16,
    /// Side of a square in millimetres
    #[arg(long, value_name = "MM", required = true)]
    square_mm: Option<f64>,
}

pub(super) fn run(arguments: &CalibrateArguments) -> Result<(), Failure> {
    let CalibrateArguments {
        part,
        board,
        output,
        images,
    } = arguments;
    if let Some(CalibrateCommand::Mount(command)) = part {
        return mount::run(command);
    }
    let square_mm = board
        .square_mm
        .context("--square-mm is missing")
        .map_err(Failure::usage)?;
    let board = Chessboard {
        columns: board.columns,
        rows: board.rows,
        square_mm,
    };
    let images = photographs(images).map_err(Failure::usage)?;
    let report = calibrate(&images, &board).context("cannot calibrate")?;
    for image in &report.without_board {
        eprintln!("the whole board was not found in {}", image.display());
    }
    let found = &report.calibration;
    found.write(output).context("cannot calibrate")?;
    let file = output.display();
    let rms_px = found.rms_px;
    let photographs = found.images.len();
    Ok(print(&format!(
        "{file}: {rms_px:.3} px rms over {photographs} photographs\n"
    ))?)
}
