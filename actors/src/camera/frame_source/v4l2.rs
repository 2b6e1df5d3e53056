//! Cameras of the kernel (Video4Linux), such as USB cameras: buffers that the driver fills,
//! converted to BGR.

mod pixels;

use std::io;
use std::path::Path;
use std::time::Duration;

use moq_v4l::buffer::{self, Metadata};
use moq_v4l::device::Handle;
use moq_v4l::io::mmap::Stream;
use moq_v4l::io::traits::{self, CaptureStream};
use moq_v4l::video::Capture;
use moq_v4l::video::capture::Parameters;
use moq_v4l::{Device, Format, FourCC, Fraction};
use rustix::event::PollFlags;
use rustix::io::Errno;

use self::pixels::{FrameLayout, PixelConversion};
use super::capture_clock::{CaptureClock, FrameStamp, TimeSource};
use super::{FrameError, FrameSource};
use crate::camera::frame::CameraFrame;
use crate::platform::clock;

/// Width and height that are requested unless configured.
const DEFAULT_SIZE: [u32; 2] = [640, 480];
const DEFAULT_FPS: f64 = 30.0;

/// Number of buffers: two for the driver while the reader has one.
const BUFFERS: u32 = 3;

/// A camera that takes pictures.
pub(super) struct V4l2Camera {
    origin: String,
    /// Present until the camera is dropped.
    stream: Option<Stream<'static>>,
    is_streaming: bool,
    layout: FrameLayout,
    timeout: Duration,
    clock: CaptureClock,
    seq: u64,
}

impl V4l2Camera {
    /// Opens a device in the first pixel format of [`pixels`] that it supports. The device uses the
    /// nearest size and rate that it supports.
    pub(super) fn open(
        device: &Path,
        size: [Option<u32>; 2],
        fps: Option<f64>,
        latency_s: Option<f64>,
        timeout: Duration,
    ) -> Result<Self, FrameError> {
        let origin = device.display().to_string();
        let failed = |reason: String| FrameError::Open {
            origin: origin.clone(),
            reason,
        };
        let refused = |step: &'static str| {
            let origin = origin.clone();
            move |error: io::Error| FrameError::Open {
                origin,
                reason: format!("{step}: {error}"),
            }
        };
        std::fs::File::open(device).map_err(|error| failed(error.to_string()))?;
        let opened = Device::with_path(device).map_err(refused("it cannot be opened"))?;
        // `query_caps` of the library panics at a name that is not UTF-8.
        if let Err(error) = opened.format()
            && error.raw_os_error() == Some(Errno::NOTTY.raw_os_error())
        {
            return Err(refused("it is no camera")(error));
        }
        let formats = opened
            .enum_formats()
            .map_err(refused("its formats cannot be listed"))?;
        if formats.is_empty() {
            return Err(failed(
                "it streams no pictures: a camera may have several devices, try the others".into(),
            ));
        }
        let offered: Vec<_> = formats.iter().map(|format| format.fourcc).collect();
        let conversion = PixelConversion::choose(&offered).ok_or_else(|| {
            failed(format!(
                "its pictures have the formats {}, need one of {}",
                names(&offered),
                names(&PixelConversion::formats())
            ))
        })?;
        let [width, height] = [0, 1].map(|side| size[side].unwrap_or(DEFAULT_SIZE[side]));
        let chosen = opened
            .set_format(&Format::new(width, height, conversion.format()))
            .map_err(refused("it refuses the format"))?;
        let layout = FrameLayout::new(conversion, &chosen).map_err(failed)?;
        let fps = fps.unwrap_or(DEFAULT_FPS);
        let interval = Fraction::new(1000, (fps * 1000.0).round().max(1.0) as u32);
        match opened.set_params(&Parameters::new(interval)) {
            Ok(Parameters { interval, .. }) => {
                tracing::debug!(camera = origin, ?layout, %interval, "camera opened");
            }
            Err(error) => {
                tracing::debug!(camera = origin, ?layout, fps, %error, "camera rejects the rate");
            }
        }
        let mut stream = Stream::with_buffers(&opened, buffer::Type::VideoCapture, BUFFERS)
            .map_err(refused("it does not start"))?;
        stream.set_timeout(timeout);
        Ok(Self {
            origin,
            stream: Some(stream),
            is_streaming: false,
            layout,
            timeout,
            clock: CaptureClock::new(latency_s),
            seq: 0,
        })
    }
}

impl Drop for V4l2Camera {
    fn drop(&mut self) {
        if let Some(stream) = self.stream.take() {
            release(stream, &self.origin);
        }
    }
}

impl FrameSource for V4l2Camera {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let is_streaming = std::mem::replace(&mut self.is_streaming, true);
        let stream = self.stream.as_mut().ok_or(io::ErrorKind::NotConnected);
        let filled = stream.map_err(io::Error::from).and_then(|stream| {
            if is_streaming {
                wait(&stream.handle(), self.timeout)?;
            }
            // Starts the camera, or returns the buffer of the frame before to the driver.
            CaptureStream::next(stream)
        });
        let (pixels, metadata) = match filled {
            Ok(filled) => filled,
            Err(error) if error.kind() == io::ErrorKind::TimedOut => {
                return Err(FrameError::Stalled(self.timeout));
            }
            Err(error) => {
                return Err(FrameError::Lost {
                    origin: self.origin.clone(),
                    reason: error.to_string(),
                });
            }
        };
        let arrived_at = clock::now();
        let stamp = age(metadata, clock::monotonic()).map(|age| FrameStamp::Time(arrived_at - age));
        let used = pixels.len().min(metadata.bytesused as usize);
        let image = if metadata.flags.contains(buffer::Flags::ERROR) {
            Err("broken on its way".into())
        } else {
            self.layout.to_bgr(&pixels[..used])
        };
        let image = image.map_err(|reason| FrameError::Unusable {
            origin: self.origin.clone(),
            reason,
        })?;
        let frame = CameraFrame {
            image,
            captured_at: self.clock.time(stamp, arrived_at),
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }

    fn time_source(&self) -> TimeSource {
        self.clock.source()
    }
}

/// Waits until a buffer is filled, or the camera is gone.
fn wait(device: &Handle, timeout: Duration) -> io::Result<()> {
    let timeout_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
    loop {
        match device.poll(PollFlags::IN.bits() as i16, timeout_ms) {
            Ok(0) => return Err(io::ErrorKind::TimedOut.into()),
            Ok(_) => return Ok(()),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// Stops and drops a stream of a camera. If the driver refuses to stop, the stream is leaked and its
/// buffers stay reserved: its drop would panic, then its buffers' drop during this panic, which ends
/// the process.
fn release(mut stream: impl traits::Stream, camera: &str) {
    match stream.stop() {
        Err(error) if error.raw_os_error() != Some(Errno::NODEV.raw_os_error()) => {
            tracing::warn!(camera, %error, "the camera does not stop: unplug it, or restart the node");
            std::mem::forget(stream);
        }
        _ => drop(stream),
    }
}

/// Time from the capture that the driver states to `now` on the monotonic clock. The driver's stamp
/// is the start of exposure or the end of the frame, by the flag `TSTAMP_SRC_SOE`
/// ([V4L2](https://docs.kernel.org/userspace-api/media/v4l/buffer.html#buffer-flags)).
///
/// `None` if the stamp is of another clock or of the future.
fn age(metadata: &Metadata, now: Duration) -> Option<Duration> {
    let clock = metadata.flags & buffer::Flags::TIMESTAMP_MASK;
    if clock != buffer::Flags::TIMESTAMP_MONOTONIC {
        return None;
    }
    let seconds = u64::try_from(metadata.timestamp.sec).ok()?;
    let micros = u64::try_from(metadata.timestamp.usec).ok()?;
    let stamp = Duration::from_secs(seconds).checked_add(Duration::from_micros(micros))?;
    now.checked_sub(stamp)
}

/// Names of pixel formats in a text.
fn names(formats: &[FourCC]) -> String {
    let names: Vec<_> = formats.iter().map(FourCC::to_string).collect();
    names.join(", ")
}

#[cfg(test)]
mod tests;
