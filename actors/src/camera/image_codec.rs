//! Image files and JPEG pictures. OpenCV's `imgcodecs` is left out: with it, Debian loads a hundred
//! libraries into a node.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use jpeg_encoder::{Encoder, EncodingError, ImageBuffer, JpegColorType, SamplingFactor};
use opencv::core::{Mat, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::platform::bounded_file;

use super::image_size::ImageSize;

/// Error of reading or writing an image.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The file cannot be read.
    #[error(transparent)]
    File(#[from] std::io::Error),
    /// The bytes are not a whole image of a supported format.
    #[error("not an image in BMP, JPEG, PNG, PNM or WebP: {0}")]
    Malformed(#[from] image::ImageError),
    /// A JPEG without its end, as after a crash or a broken transfer.
    #[error("the JPEG is cut off: its end is missing")]
    CutOff,
    /// The image is wider or higher than JPEG allows.
    #[error("{0} pixels are too many for JPEG, at most 65535 in a line")]
    TooLarge(ImageSize),
    /// The image has no pixels.
    #[error("cannot encode as JPEG")]
    Encoding(#[from] EncodingError),
    /// OpenCV failed in a step of the conversion.
    #[error("opencv failed on an image")]
    OpenCv(#[from] opencv::Error),
}

/// Maximum size in bytes of a decoded image: 10,000 by 8000 pixels with four channels fit. A header
/// of a few bytes may state more than the machine's memory.
const MAX_DECODED_BYTES: u64 = 320_000_000;

/// Maximum size of an image file in bytes.
const MAX_FILE_BYTES: u64 = 256 * 1024 * 1024;

/// Reads an image file and decodes it with [`decode`].
///
/// # Errors
/// Returns [`ImageError::File`] or an error of [`decode`].
pub fn read(path: &Path) -> Result<Mat, ImageError> {
    decode(&bounded_file::read(path, MAX_FILE_BYTES)?)
}

/// Decodes an image in BMP, JPEG, PNG, PNM or WebP to 8-bit BGR without transparency, turned
/// upright by its EXIF data.
///
/// # Errors
/// Returns [`ImageError::Malformed`], [`ImageError::CutOff`] or [`ImageError::OpenCv`].
pub fn decode(bytes: &[u8]) -> Result<Mat, ImageError> {
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    let is_jpeg = reader.format() == Some(ImageFormat::Jpeg);
    let mut decoder = reader.into_decoder()?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_DECODED_BYTES);
    limits.reserve(decoder.total_bytes())?;
    let orientation = decoder.orientation()?;
    let mut image = DynamicImage::from_decoder(decoder)?;
    // The decoder fills missing parts with gray.
    if is_jpeg && !has_end_of_image(bytes) {
        return Err(ImageError::CutOff);
    }
    image.apply_orientation(orientation);
    let rgb = image.into_rgb8();
    let pixels = Mat::new_rows_cols_with_bytes::<Vec3b>(
        rgb.height() as i32,
        rgb.width() as i32,
        rgb.as_raw(),
    )?;
    let mut bgr = Mat::default();
    imgproc::cvt_color_def(&pixels, &mut bgr, imgproc::COLOR_RGB2BGR)?;
    Ok(bgr)
}

/// Segment by which decoders recognise motion JPEG: without Huffman tables of its own, the image
/// uses the tables of the JPEG standard, K.3.
const MOTION_JPEG: &[u8] = b"\xff\xe0\0\x07AVI1\0";

/// Decodes a picture of motion JPEG, perhaps without Huffman tables, as [`decode`].
///
/// # Errors
/// Returns an error of [`decode`].
pub(crate) fn decode_motion_jpeg(bytes: &[u8]) -> Result<Mat, ImageError> {
    let (start, rest) = bytes.split_at(bytes.len().min(2));
    decode(&[start, MOTION_JPEG, rest].concat())
}

/// True if a JPEG has the marker of its end (ITU-T T.81, B.1.1.3), outside of its segments: a
/// thumbnail inside a segment has one, too.
fn has_end_of_image(jpeg: &[u8]) -> bool {
    const START_OF_IMAGE: u8 = 0xD8;
    const END_OF_IMAGE: u8 = 0xD9;
    let mut rest = jpeg.get(2..).unwrap_or_default();
    // In coded data, 0xFF precedes a zero or a restart marker, 0xD0 to 0xD7; a marker may have
    // several 0xFF before it.
    while let Some(at) = rest
        .windows(2)
        .position(|pair| pair[0] == 0xFF && !matches!(pair[1], 0x00 | 0x01 | 0xFF | 0xD0..=0xD7))
    {
        match rest[at + 1] {
            END_OF_IMAGE => return true,
            // The next picture of a stream.
            START_OF_IMAGE => return false,
            _ => {}
        }
        let segment = &rest[at + 2..];
        let length = segment
            .first_chunk()
            .map(|length| u16::from_be_bytes(*length));
        let after = length.and_then(|length| segment.get(usize::from(length)..));
        let Some(after) = after else {
            return false;
        };
        rest = after;
    }
    false
}

/// JPEG of an 8-bit image, BGR or gray. `quality` is 1 to 100. Colours have half the resolution, as
/// in OpenCV's files.
///
/// # Errors
/// Returns [`ImageError::TooLarge`], [`ImageError::Encoding`], or [`ImageError::OpenCv`] for an
/// image of another type.
pub fn encode_jpeg(image: &Mat, quality: u8) -> Result<Vec<u8>, ImageError> {
    let size = ImageSize::of(image);
    let side = |pixels| u16::try_from(pixels).map_err(|_| ImageError::TooLarge(size));
    let mut colors = Mat::default();
    let is_gray = image.channels() == 1;
    if !is_gray {
        imgproc::cvt_color_def(image, &mut colors, imgproc::COLOR_BGR2YCrCb)?;
    }
    let pixels = if is_gray {
        image.data_bytes()?
    } else {
        colors.data_bytes()?
    };
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, quality);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    encoder.encode_image(Pixels {
        pixels,
        width: side(size.width)?,
        height: side(size.height)?,
        is_gray,
    })?;
    Ok(jpeg)
}

/// An image in JPEG's own colour space. The program then contains only this one of the encoder's
/// many image types.
struct Pixels<'a> {
    /// Rows of brightness, with Cr and Cb unless it is gray.
    pixels: &'a [u8],
    width: u16,
    height: u16,
    is_gray: bool,
}

impl ImageBuffer for Pixels<'_> {
    fn get_jpeg_color_type(&self) -> JpegColorType {
        if self.is_gray {
            JpegColorType::Luma
        } else {
            JpegColorType::Ycbcr
        }
    }

    fn width(&self) -> u16 {
        self.width
    }

    fn height(&self) -> u16 {
        self.height
    }

    fn fill_buffers(&self, y: u16, [brightness, cb, cr, _]: &mut [Vec<u8>; 4]) {
        let row = usize::from(y);
        let width = usize::from(self.width);
        if self.is_gray {
            return brightness.extend_from_slice(&self.pixels[row * width..][..width]);
        }
        let (pixels, _) = self.pixels[row * width * 3..][..width * 3].as_chunks::<3>();
        brightness.extend(pixels.iter().map(|pixel| pixel[0]));
        cr.extend(pixels.iter().map(|pixel| pixel[1]));
        cb.extend(pixels.iter().map(|pixel| pixel[2]));
    }
}

#[cfg(test)]
mod tests;
