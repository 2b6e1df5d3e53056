//! An image fitted into a network's input, and boxes brought back from there.

use ecod::model::detection::BoundingBox;
use opencv::core::{Mat, Size};
use opencv::imgproc;
use opencv::prelude::*;

use crate::camera::image_size::ImageSize;

/// Where an image goes in an input of another shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    /// In the middle, with its shape kept.
    Centred,
    /// In the upper left, with its shape kept.
    TopLeft,
    /// All over, its shape not kept.
    Stretched,
}

/// Gray level of the padding around the image, as in the training of all families that keep its
/// shape.
const PADDING: u8 = 114;

/// An image's place in a network's input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Letterbox {
    input: ImageSize,
    left: u32,
    top: u32,
    /// Size of the image in the input.
    scaled: ImageSize,
    scale_x: f64,
    scale_y: f64,
}

impl Letterbox {
    /// The place of an image.
    pub(super) fn new(fit: Fit, image: ImageSize, input: ImageSize) -> Self {
        let [image_width, image_height] = [image.width, image.height].map(f64::from);
        let most_x = f64::from(input.width) / image_width;
        let most_y = f64::from(input.height) / image_height;
        let (scale_x, scale_y) = match fit {
            Fit::Stretched => (most_x, most_y),
            Fit::Centred | Fit::TopLeft => (most_x.min(most_y), most_x.min(most_y)),
        };
        // YOLOX cuts off parts of a pixel, the others round.
        let whole = |length: f64| {
            if fit == Fit::TopLeft {
                length.floor()
            } else {
                length.round()
            }
        };
        let side = |length: f64, most: u32| (whole(length) as u32).clamp(1, most);
        let width = side(image_width * scale_x, input.width);
        let height = side(image_height * scale_y, input.height);
        let (left, top) = match fit {
            // An odd pixel goes to the right and below, as in Ultralytics' `LetterBox`.
            Fit::Centred => ((input.width - width) / 2, (input.height - height) / 2),
            Fit::TopLeft | Fit::Stretched => (0, 0),
        };
        let scale_x = f64::from(width) / image_width;
        let scale_y = f64::from(height) / image_height;
        Self {
            input,
            left,
            top,
            scaled: ImageSize { width, height },
            scale_x,
            scale_y,
        }
    }

    /// A box of the input in pixels of the image.
    pub(super) fn to_image(self, b: &BoundingBox) -> BoundingBox {
        let left = f64::from(self.left);
        let top = f64::from(self.top);
        BoundingBox {
            x_min: (b.x_min - left) / self.scale_x,
            y_min: (b.y_min - top) / self.scale_y,
            x_max: (b.x_max - left) / self.scale_x,
            y_max: (b.y_max - top) / self.scale_y,
        }
    }

    /// The input's numbers for an image of 8-bit blue, green and red. `convert` returns the numbers
    /// of a pixel in the order of the network's channels, which are planes or, with
    /// `channels_last`, adjacent.
    pub(super) fn fill(
        self,
        image: &Mat,
        channels_last: bool,
        convert: impl Fn([u8; 3]) -> [f32; 3],
    ) -> opencv::Result<Vec<f32>> {
        let mut resized = Mat::default();
        let size = Size::new(self.scaled.width as i32, self.scaled.height as i32);
        imgproc::resize(image, &mut resized, size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        let [width, height, left, top, scaled_width] = [
            self.input.width,
            self.input.height,
            self.left,
            self.top,
            self.scaled.width,
        ]
        .map(|side| side as usize);
        let plane = width * height;
        let mut numbers = vec![0.0; 3 * plane];
        let mut put = |pixel: usize, values: [f32; 3]| {
            for (channel, value) in values.into_iter().enumerate() {
                numbers[if channels_last {
                    pixel * 3 + channel
                } else {
                    channel * plane + pixel
                }] = value;
            }
        };
        let padding = convert([PADDING; 3]);
        (0..plane).for_each(|pixel| put(pixel, padding));
        for (row, pixels) in resized
            .data_bytes()?
            .chunks_exact(3 * scaled_width)
            .enumerate()
        {
            let first = (top + row) * width + left;
            for (column, pixel) in pixels.chunks_exact(3).enumerate() {
                put(first + column, convert([pixel[0], pixel[1], pixel[2]]));
            }
        }
        Ok(numbers)
    }
}
