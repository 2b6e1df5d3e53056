//! Messages between the node and the program `ecod-video`, each a line of JSON. Both are of one
//! build.

use std::io::{self, Write};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::camera::frame_source::{FrameError, SourceConfig, TimeSource};

/// The first and only line for the program. On a command line, every user of the machine could read
/// the source's secrets.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct VideoRequest {
    pub(super) source: SourceConfig,
    /// Time after which a silent network camera is given up.
    pub(super) timeout: Duration,
}

/// A line of the program.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum VideoMessage {
    /// The source is open; frames follow.
    Opened,
    /// A frame, whose pixels follow row by row.
    Frame(ImageHeader),
    /// The last line, unless [`FrameError::is_passing`].
    Failed(FrameError),
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct ImageHeader {
    pub(super) rows: i32,
    pub(super) columns: i32,
    /// OpenCV's type of a pixel, such as `CV_8UC3`.
    pub(super) kind: i32,
    /// Time of capture since the boot of the machine.
    pub(super) since_boot: Duration,
    pub(super) time_source: TimeSource,
}

pub(super) fn write_line(output: &mut impl Write, message: &impl Serialize) -> io::Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    output.write_all(&line)
}
