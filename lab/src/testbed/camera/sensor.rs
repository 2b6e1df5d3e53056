//! Disturbances that a small camera on a running vehicle adds to a view: vibration, blur, uneven
//! light and noise.

use opencv::core::{BORDER_REPLICATE, Mat, Point2f, Scalar, Size};
use opencv::imgproc::{INTER_LINEAR, gaussian_blur, get_rotation_matrix_2d, warp_affine};
use opencv::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::RenderError;

/// Standard deviation of the shift of a frame in each direction, in pixels.
const SHIFT_PX: f64 = 0.5;
/// Standard deviation of the rotation of a frame, in degrees.
const ROTATION_DEG: f64 = 0.08;
/// Least and largest blur out of focus, a standard deviation in pixels.
const DEFOCUS_PX: [f64; 2] = [0.6, 0.8];
/// Longest way of the image during the exposure, in pixels, across and along the columns.
const MOTION_PX: [f64; 2] = [1.5, 0.6];
/// Standard deviation of the exposure, as a factor.
const EXPOSURE: f64 = 0.03;
/// Largest change of light from the middle of the image to an edge, as a factor.
const GRADIENT: f64 = 0.12;
/// Loss of light at the edges, as a factor.
const VIGNETTE: f64 = 0.06;
/// Least and largest noise of one value of 0 to 255, a standard deviation.
const NOISE: [f64; 2] = [4.0, 6.0];
/// Values drawn once, of which each row of each frame takes a random stretch.
const NOISE_BANK: usize = 1 << 19;

/// The disturbances of one camera.
#[derive(Debug)]
pub(crate) struct Sensor {
    seed: u64,
    /// Direction and strength of the uneven light, right and downwards.
    gradient: [f64; 2],
    /// Normally distributed with standard deviation 1.
    noise: Vec<f32>,
}

impl Sensor {
    pub(crate) fn new(still: &Mat, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let gradient = [0; 2].map(|_| rng.random_range(-GRADIENT..=GRADIENT));
        let row_values = 3 * still.cols().unsigned_abs() as usize;
        let noise = (0..NOISE_BANK.max(4 * row_values))
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        Self {
            seed,
            gradient,
            noise,
        }
    }

    /// The view as the camera takes it at frame `index`.
    pub(crate) fn expose(&self, still: &Mat, index: u64) -> Result<Mat, RenderError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(index.wrapping_add(1));
        let shaken = shake(still, &mut rng)?;
        let mut frame = blur(&shaken, &mut rng)?;
        self.develop(&mut frame, &mut rng)?;
        Ok(frame)
    }

    /// Uneven light and noise, in place.
    fn develop(&self, frame: &mut Mat, rng: &mut ChaCha8Rng) -> Result<(), RenderError> {
        let columns = frame.cols().unsigned_abs() as usize;
        let rows = frame.rows().unsigned_abs() as usize;
        let exposure = 1.0 + EXPOSURE * normal(rng);
        let sigma = rng.random_range(NOISE[0]..=NOISE[1]) as f32;
        let across: Vec<f32> = (0..3 * columns)
            .map(|value| gain(value / 3, columns, self.gradient[0]))
            .collect();
        let values = frame
            .data_bytes_mut()
            .map_err(RenderError::at("reading a frame"))?;
        for (row, values) in values.chunks_exact_mut(3 * columns).enumerate() {
            let light = exposure as f32 * gain(row, rows, self.gradient[1]);
            let start = rng.random_range(0..self.noise.len() - values.len());
            for ((value, across), noise) in values.iter_mut().zip(&across).zip(&self.noise[start..])
            {
                *value = (f32::from(*value) * light * across + sigma * noise + 0.5) as u8;
            }
        }
        Ok(())
    }
}

/// A small shift and rotation about the middle of the image.
fn shake(still: &Mat, rng: &mut ChaCha8Rng) -> Result<Mat, RenderError> {
    let error = || RenderError::at("shaking a view");
    let middle = Point2f::new(
        (still.cols() - 1) as f32 / 2.0,
        (still.rows() - 1) as f32 / 2.0,
    );
    let mut motion =
        get_rotation_matrix_2d(middle, ROTATION_DEG * normal(rng), 1.0).map_err(error())?;
    for row in 0..2 {
        *motion.at_2d_mut::<f64>(row, 2).map_err(error())? += SHIFT_PX * normal(rng);
    }
    let size = Size::new(still.cols(), still.rows());
    let mut shaken = Mat::default();
    warp_affine(
        still,
        &mut shaken,
        &motion,
        size,
        INTER_LINEAR,
        BORDER_REPLICATE,
        Scalar::default(),
    )
    .map_err(error())?;
    Ok(shaken)
}

/// Defocus and motion; a motion of L pixels blurs as L²/12 of variance does.
fn blur(image: &Mat, rng: &mut ChaCha8Rng) -> Result<Mat, RenderError> {
    let defocus = rng.random_range(DEFOCUS_PX[0]..=DEFOCUS_PX[1]);
    let sigma = MOTION_PX.map(|longest| {
        let motion = rng.random_range(0.0..=longest);
        (defocus * defocus + motion * motion / 12.0).sqrt()
    });
    let mut blurred = Mat::default();
    gaussian_blur(
        image,
        &mut blurred,
        Size::default(),
        sigma[0],
        sigma[1],
        BORDER_REPLICATE,
    )
    .map_err(RenderError::at("blurring a view"))?;
    Ok(blurred)
}

/// Light along one direction of the image: a gradient and the loss towards the edges.
fn gain(at: usize, length: usize, gradient: f64) -> f32 {
    let off_middle = (2 * at + 1) as f64 / length as f64 - 1.0;
    (1.0 + gradient * off_middle - VIGNETTE * off_middle * off_middle) as f32
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(rng)
}
