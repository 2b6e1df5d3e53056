//! Conversion from a camera's pixel formats to BGR. Names, layouts and sizes of the formats are
//! taken from the kernel's
//! [Video4Linux API](https://docs.kernel.org/userspace-api/media/v4l/pixfmt.html).

use moq_v4l::{Format, FourCC};
use opencv::core::{Mat, Rect, Vec2b, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::camera::image_codec;

/// Conversion of one pixel format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PixelConversion {
    fourcc: [u8; 4],
    way: Way,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// The image as it is.
    Same,
    /// A JPEG file, perhaps without Huffman tables.
    Jpeg,
    /// Pixels of this number of bytes, converted by a function of OpenCV.
    Packed(usize, i32),
    /// Brightness in full resolution, and half as many bytes below for the colours, converted by a
    /// function of OpenCV.
    Planar(i32),
}

/// The conversions, the preferred first: OpenCV's order.
const CONVERSIONS: [PixelConversion; 11] = {
    const fn of(fourcc: &[u8; 4], way: Way) -> PixelConversion {
        PixelConversion {
            fourcc: *fourcc,
            way,
        }
    }
    [
        of(b"BGR3", Way::Same),
        of(b"RGB3", Way::Packed(3, imgproc::COLOR_RGB2BGR)),
        of(b"YV12", Way::Planar(imgproc::COLOR_YUV2BGR_YV12)),
        of(b"YU12", Way::Planar(imgproc::COLOR_YUV2BGR_IYUV)),
        of(b"YUYV", Way::Packed(2, imgproc::COLOR_YUV2BGR_YUYV)),
        of(b"UYVY", Way::Packed(2, imgproc::COLOR_YUV2BGR_UYVY)),
        of(b"NV12", Way::Planar(imgproc::COLOR_YUV2BGR_NV12)),
        of(b"NV21", Way::Planar(imgproc::COLOR_YUV2BGR_NV21)),
        of(b"MJPG", Way::Jpeg),
        of(b"JPEG", Way::Jpeg),
        of(b"GREY", Way::Packed(1, imgproc::COLOR_GRAY2BGR)),
    ]
};

impl PixelConversion {
    /// All formats that can be converted, the preferred first.
    pub(super) fn formats() -> [FourCC; CONVERSIONS.len()] {
        CONVERSIONS.map(Self::format)
    }

    /// The preferred format among those that a camera offers.
    pub(super) fn choose(offered: &[FourCC]) -> Option<Self> {
        CONVERSIONS
            .into_iter()
            .find(|conversion| offered.contains(&conversion.format()))
    }

    pub(super) fn format(self) -> FourCC {
        FourCC::new(&self.fourcc)
    }
}

/// How a camera's frames lie in its buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FrameLayout {
    way: Way,
    width: i32,
    height: i32,
    /// Bytes from a row to the next, which may be more than its pixels need; for planar formats, of
    /// the brightness plane.
    stride: usize,
}

impl FrameLayout {
    /// The layout of the format that the driver has chosen, which may have another size than
    /// requested.
    pub(super) fn new(conversion: PixelConversion, chosen: &Format) -> Result<Self, String> {
        let got = chosen.fourcc;
        let wanted = conversion.format();
        if got != wanted {
            return Err(format!(
                "it has the format {wanted} and gives {got}: another program may use it"
            ));
        }
        Self::of(conversion.way, [chosen.width, chosen.height], chosen.stride)
    }

    fn of(way: Way, [width, height]: [u32; 2], bytes_per_line: u32) -> Result<Self, String> {
        let unfit = || {
            format!(
                "its pictures of {width}x{height} pixels with {bytes_per_line} bytes in a row cannot be read"
            )
        };
        let [width, height] = [width, height].map(|side| i32::try_from(side).map_err(|_| unfit()));
        let layout = Self {
            way,
            width: width?,
            height: height?,
            stride: 0,
        };
        let pixel = way.bytes_of_pixel();
        let row = layout.width as usize * pixel;
        let stride = if bytes_per_line == 0 {
            row
        } else {
            bytes_per_line as usize
        };
        if way != Way::Jpeg && (stride < row || stride % pixel != 0) {
            return Err(unfit());
        }
        Ok(Self { stride, ..layout })
    }

    /// The image in a buffer as BGR.
    pub(super) fn to_bgr(self, buffer: &[u8]) -> Result<Mat, String> {
        if self.way == Way::Jpeg {
            return image_codec::decode_motion_jpeg(buffer).map_err(|error| error.to_string());
        }
        let rows = if matches!(self.way, Way::Planar(_)) {
            self.height / 2 * 3
        } else {
            self.height
        };
        let length = rows as usize * self.stride;
        let bytes = buffer
            .get(..length)
            .ok_or_else(|| format!("{} of {length} bytes", buffer.len()))?;
        self.convert(rows, bytes).map_err(|error| error.message)
    }

    fn convert(self, rows: i32, bytes: &[u8]) -> opencv::Result<Mat> {
        let columns = (self.stride / self.way.bytes_of_pixel()) as i32;
        let pixels = match self.way.bytes_of_pixel() {
            1 => Mat::new_rows_cols_with_bytes::<u8>(rows, columns, bytes)?,
            2 => Mat::new_rows_cols_with_bytes::<Vec2b>(rows, columns, bytes)?,
            _ => Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, bytes)?,
        };
        let mut bgr = Mat::default();
        match self.way {
            Way::Packed(_, code) | Way::Planar(code) => {
                imgproc::cvt_color_def(&pixels, &mut bgr, code)?;
            }
            Way::Same | Way::Jpeg => pixels.copy_to(&mut bgr)?,
        }
        if columns == self.width {
            return Ok(bgr);
        }
        Mat::roi(&bgr, Rect::new(0, 0, self.width, self.height))?.try_clone()
    }
}

impl Way {
    /// Bytes per pixel; for planar formats, of the brightness plane.
    fn bytes_of_pixel(self) -> usize {
        match self {
            Self::Same => 3,
            Self::Packed(bytes, _) => bytes,
            Self::Planar(_) | Self::Jpeg => 1,
        }
    }
}

#[cfg(test)]
mod tests;
