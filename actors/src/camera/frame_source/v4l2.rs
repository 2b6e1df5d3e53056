//! Cameras of the kernel (Video4Linux), such as USB cameras: buffers that the driver fills,
//! converted to BGR.

mod pixels;

use std::io;
use std::os::fd::AsFd;
use std::path::Path;
use std::time::Duration;

use linuxvideo::format::PixFormat;
use linuxvideo::stream::ReadStream;
use linuxvideo::{BufType, CapabilityFlags, Device, Fract};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use self::pixels::{FrameLayout, PixelConversion};
use super::{FrameError, FrameSource};
use crate::camera::frame::CameraFrame;
use crate::platform::clock;

/// Width and height that are requested unless configured.
const DEFAULT_SIZE: [u32; 2] = [640, 480];
const DEFAULT_FPS: f64 = 30.0;

/// A camera that takes pictures.
pub(super) struct V4l2Camera {
    origin: String,
    stream: ReadStream,
    layout: FrameLayout,
    timeout: Duration,
    seq: u64,
}

impl V4l2Camera {
    /// Opens a device in the first pixel format of [`pixels`] that it supports. The device uses the
    /// nearest size and rate that it supports.
    pub(super) fn open(
        device: &Path,
        size: [Option<u32>; 2],
        fps: Option<f64>,
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
        let opened = Device::open(device).map_err(refused("it is no camera"))?;
        let able = opened
            .capabilities()
            .map_err(refused("it is no camera"))?
            .device_capabilities();
        if !able.contains(CapabilityFlags::VIDEO_CAPTURE | CapabilityFlags::STREAMING) {
            return Err(failed(
                "it streams no pictures: a camera may have several devices, try the others".into(),
            ));
        }
        let offered = opened
            .formats(BufType::VIDEO_CAPTURE)
            .map(|format| Ok(format?.pixel_format()))
            .collect::<io::Result<Vec<_>>>()
            .map_err(refused("its formats cannot be listed"))?;
        let conversion = PixelConversion::choose(&offered).ok_or_else(|| {
            failed(format!(
                "its pictures have the formats {offered:?}, need one of {:?}",
                PixelConversion::formats()
            ))
        })?;
        let [width, height] = [0, 1].map(|side| size[side].unwrap_or(DEFAULT_SIZE[side]));
        let camera = opened
            .video_capture(PixFormat::new(width, height, conversion.format()))
            .map_err(refused("it refuses the format"))?;
        let layout = FrameLayout::new(conversion, camera.format()).map_err(failed)?;
        let fps = fps.unwrap_or(DEFAULT_FPS);
        match camera.set_frame_interval(Fract::new(1000, (fps * 1000.0).round().max(1.0) as u32)) {
            Ok(interval) => tracing::debug!(camera = origin, ?layout, %interval, "camera opened"),
            Err(error) => {
                tracing::debug!(camera = origin, ?layout, fps, %error, "camera rejects the rate");
            }
        }
        let stream = camera.into_stream().map_err(refused("it does not start"))?;
        Ok(Self {
            origin,
            stream,
            layout,
            timeout,
            seq: 0,
        })
    }

    fn lost(&self, error: &io::Error) -> FrameError {
        FrameError::Lost {
            origin: self.origin.clone(),
            reason: error.to_string(),
        }
    }

    /// Waits until a buffer is filled, or the camera is gone.
    fn wait(&self) -> Result<(), FrameError> {
        let timeout =
            Timespec::try_from(self.timeout).map_err(|e| self.lost(&io::Error::other(e)))?;
        loop {
            match poll(
                &mut [PollFd::new(&self.stream.as_fd(), PollFlags::IN)],
                Some(&timeout),
            ) {
                Ok(0) => return Err(FrameError::Stalled(self.timeout)),
                Ok(_) => return Ok(()),
                Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(self.lost(&error.into())),
            }
        }
    }
}

impl FrameSource for V4l2Camera {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        self.wait()?;
        let layout = self.layout;
        let taken = self.stream.dequeue(|buffer| {
            let captured_at = clock::now();
            let image = if buffer.is_error() {
                Err("broken on its way".into())
            } else {
                layout.to_bgr(&buffer)
            };
            Ok((captured_at, image))
        });
        let (captured_at, image) = taken.map_err(|error| self.lost(&error))?;
        let image = image.map_err(|reason| FrameError::Unusable {
            origin: self.origin.clone(),
            reason,
        })?;
        let frame = CameraFrame {
            image,
            captured_at,
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }
}
