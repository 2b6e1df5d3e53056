//! The mount of a camera from boxes of people who walk on level ground.
//!
//! The position of a box in the image determines its expected height, which gives the horizon and
//! the height of the camera (Hoiem, Efros, Hebert, *Putting Objects in Perspective*, IJCV 2008; Lv,
//! Zhao, Nevatia, *Camera Calibration from Video of a Walking Human*, IEEE T-PAMI 2006). Each
//! person has a height of their own, which is estimated too. Errors of a box follow Student's t
//! distribution, so that a box that does not show the whole person counts little (Lange, Little,
//! Taylor, JASA 1989).

use nalgebra::{Matrix3, Vector3};

use super::error_sources::Source;
use super::ground::HalfDepth;
use super::{ObjectSize, Projection, ProjectionConfig, box_height};
use crate::model::detection::BoundingBox;
use crate::perception::camera::{Intrinsics, Mount};

/// An estimated mount, with standard deviations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MountEstimate {
    /// The mount with the estimated height, pitch and roll.
    pub mount: Mount,
    /// Of the pitch, in radians.
    pub pitch_sigma_rad: f64,
    /// Of the roll, in radians.
    pub roll_sigma_rad: f64,
    /// Of the height, in metres.
    pub height_sigma_m: f64,
}

/// The reason why boxes give no mount.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MountFitError {
    /// Fewer than [`MIN_BOXES`] whole boxes; the value is their number.
    #[error("{0} whole boxes, need {MIN_BOXES}: watch for longer, or where more people walk")]
    TooFewBoxes(usize),
    /// The people are at one distance.
    #[error(
        "all people look equally high, {0:.2} times at most: let them walk from near the camera to far from it, with their feet \
         in view"
    )]
    OneDistance(f64),
    /// The boxes fit many mounts.
    #[error(
        "the boxes determine the pitch only to ±{0:.1}°: let people walk from near the camera to far from it, with their feet \
         in view"
    )]
    Undetermined(f64),
}

/// Minimum number of boxes.
pub const MIN_BOXES: usize = 40;
/// Least ratio of large boxes to small ones, of which a tenth each are beyond. Errors of the edges
/// alone make small ones.
const MIN_HEIGHT_RATIO: f64 = 1.15;
/// Boxes beyond are thinned out evenly.
const MAX_BOXES: usize = 3000;
/// Overlap from which a box in the next frame is taken to be of the same person.
const MIN_OVERLAP: f64 = 0.2;
/// Degrees of freedom of the errors' distribution; few are robust, and 4 is the customary choice.
const FREEDOM: f64 = 4.0;
/// Standard deviation of the height of one person who walks, relative to the mean.
const GAIT_SIGMA: f64 = 0.02;
/// Standard deviation of the nearest foot from the edge of a person's footprint, relative to the
/// height.
const STEP_SIGMA: f64 = 0.06;
/// Standard deviation in radians of the prior of the roll, for boxes that contain no information
/// about it.
const ROLL_PRIOR_RAD: f64 = 0.17;
/// Pitches and rolls in degrees from which the search starts.
const PITCHES_DEG: std::ops::RangeInclusive<i32> = -20..=80;
const ROLLS_DEG: [f64; 3] = [0.0, -12.0, 12.0];
/// Standard deviations of the tilt in radians and of the height (relative) due to the model: people
/// are not boxes, and detectors cut off legs. The values are the errors in the tests.
const MODEL_TILT_RAD: f64 = 0.007;
const MODEL_HEIGHT: f64 = 0.02;
/// Maximum standard deviation in degrees of a pitch that is worth reporting.
const MAX_PITCH_SIGMA_DEG: f64 = 3.0;

/// Estimates the height and tilt of a camera from the people in its frames; the other fields are
/// copied from `mount`.
///
/// Boxes are whole, without distortion, and have errors of `pixel_sigma_px`; `size` is the size of
/// people.
///
/// # Errors
/// Returns [`MountFitError`] if there are too few boxes or they are too much alike.
pub fn fit_mount(
    frames: &[Vec<BoundingBox>],
    size: &ObjectSize,
    pixel_sigma_px: f64,
    intrinsics: &Intrinsics,
    mount: &Mount,
) -> Result<MountEstimate, MountFitError> {
    let (boxes, people) = linked(frames);
    if boxes.len() < MIN_BOXES {
        return Err(MountFitError::TooFewBoxes(boxes.len()));
    }
    let mut heights: Vec<f64> = boxes
        .iter()
        .map(|person| person.bounding_box.height())
        .collect();
    heights.sort_by(f64::total_cmp);
    let ratio = heights[heights.len() * 9 / 10] / heights[heights.len() / 10];
    if ratio < MIN_HEIGHT_RATIO {
        return Err(MountFitError::OneDistance(ratio));
    }
    let boxes = boxes
        .iter()
        .step_by(boxes.len().div_ceil(MAX_BOXES))
        .copied()
        .collect();
    let config = ProjectionConfig {
        pixel_sigma_px,
        ..ProjectionConfig::default()
    };
    let fit = HeightFit {
        boxes,
        people,
        size: *size,
        config,
        intrinsics: *intrinsics,
        mount: *mount,
    };
    let (start, grown, _) = fit.improved(fit.start(), vec![1.0; fit.people], |off| {
        (FREEDOM + 1.0) / (FREEDOM + off * off)
    });
    // Errors beyond a few medians are not counted.
    let mut off: Vec<f64> = fit
        .errors(&start, &grown)
        .iter()
        .flatten()
        .map(|e| e.in_sigmas(e.own_sigma).abs())
        .collect();
    off.sort_by(f64::total_cmp);
    let scale = off
        .get(off.len() / 2)
        .map_or(1.0, |median| (median * NORMAL_MEDIAN).max(MIN_SCALE));
    let (found, _, covariance) =
        fit.improved(start, grown, |off| (-(off / scale / WELSCH).powi(2)).exp());
    let covariance = covariance * (scale * scale);
    let model = Vector3::new(MODEL_TILT_RAD, MODEL_TILT_RAD, MODEL_HEIGHT);
    let variance = covariance.diagonal() + model.component_mul(&model);
    let [pitch_sigma_rad, roll_sigma_rad, height_sigma] = variance.map(f64::sqrt).into();
    let pitch_sigma_deg = pitch_sigma_rad.to_degrees();
    if pitch_sigma_deg <= MAX_PITCH_SIGMA_DEG && height_sigma.is_finite() {
        let height_sigma_m = found.z.exp() * height_sigma;
        Ok(MountEstimate {
            mount: fit.mount(&found),
            pitch_sigma_rad,
            roll_sigma_rad,
            height_sigma_m,
        })
    } else {
        Err(MountFitError::Undetermined(pitch_sigma_deg))
    }
}

/// A box and the number of its person.
#[derive(Debug, Clone, Copy)]
struct PersonBox {
    bounding_box: BoundingBox,
    person: usize,
}

/// All boxes, and the number of people. A box belongs to the same person as the box of the previous
/// frame with which it overlaps most.
fn linked(frames: &[Vec<BoundingBox>]) -> (Vec<PersonBox>, usize) {
    let mut all = Vec::new();
    let mut before = Vec::<PersonBox>::new();
    let mut people = 0;
    for frame in frames {
        let mut now = Vec::with_capacity(frame.len());
        for bounding_box in frame {
            let overlap =
                |other: &PersonBox| other.bounding_box.intersection_over_union(bounding_box);
            let nearest = (0..before.len())
                .max_by(|a, b| overlap(&before[*a]).total_cmp(&overlap(&before[*b])));
            let person = match nearest.filter(|index| overlap(&before[*index]) >= MIN_OVERLAP) {
                Some(index) => before.swap_remove(index).person,
                None => {
                    people += 1;
                    people - 1
                }
            };
            now.push(PersonBox {
                bounding_box: *bounding_box,
                person,
            });
        }
        all.extend_from_slice(&now);
        before = now;
    }
    (all, people)
}

/// The search for pitch, roll (both in radians) and the logarithm of the height in metres.
#[derive(Debug)]
struct HeightFit {
    boxes: Vec<PersonBox>,
    people: usize,
    size: ObjectSize,
    config: ProjectionConfig,
    intrinsics: Intrinsics,
    mount: Mount,
}

/// How far the head of a box is from where its foot puts it, as slopes below the horizon.
#[derive(Debug, Clone, Copy)]
struct HeadError {
    error: f64,
    /// Standard deviation by the head and the gait.
    own_sigma: f64,
    /// Standard deviation by the foot.
    foot_sigma: f64,
    /// Change of the error with the person's height, relative to the mean.
    by_height: f64,
}

impl HeadError {
    /// The error in standard deviations. Because the foot determines the expected head, the foot's
    /// own error is included as in Deming's regression, with its effect at these parameters.
    fn in_sigmas(&self, own_sigma: f64) -> f64 {
        self.error / own_sigma.hypot(self.foot_sigma)
    }
}

/// Sums over the boxes of one person for the least squares.
#[derive(Debug, Clone, Copy)]
struct PersonSums {
    information: f64,
    gradient: f64,
    shared: Vector3<f64>,
}

impl HeightFit {
    fn mount(&self, at: &Vector3<f64>) -> Mount {
        Mount {
            pitch_rad: at.x,
            roll_rad: at.y,
            height_m: Some(at.z.exp()),
            ..self.mount
        }
    }

    fn projection(&self, at: &Vector3<f64>) -> Projection {
        Projection::new(self.config.clone(), self.intrinsics, self.mount(at))
    }

    /// The likeliest of a grid of angles, each with the median of the heights that the boxes give.
    fn start(&self) -> Vector3<f64> {
        let angles = PITCHES_DEG
            .flat_map(|pitch_deg| ROLLS_DEG.map(|roll_deg| (f64::from(pitch_deg), roll_deg)));
        let candidates = angles.filter_map(|(pitch_deg, roll_deg)| {
            let level = Vector3::new(pitch_deg.to_radians(), roll_deg.to_radians(), 0.0);
            let projection = self.projection(&level);
            let height = |person: &PersonBox| {
                let (foot, head) = box_height::foot_and_head(&person.bounding_box, &projection);
                let height_m = self.size.height_m * foot.slope / (foot.slope - head.slope);
                (foot.slope > 0.0 && height_m > 0.0).then_some(height_m)
            };
            let mut heights: Vec<f64> = self.boxes.iter().filter_map(height).collect();
            heights.sort_by(f64::total_cmp);
            Some(Vector3::new(
                level.x,
                level.y,
                heights.get(heights.len() / 2)?.ln(),
            ))
        });
        let costed = candidates.map(|candidate| (self.cost(&candidate), candidate));
        costed
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map_or_else(Vector3::zeros, |(_, candidate)| candidate)
    }

    /// The negative logarithm of the likelihood, of people of unknown height.
    fn cost(&self, at: &Vector3<f64>) -> f64 {
        let cost = |error: Option<HeadError>| match error {
            Some(HeadError {
                error,
                own_sigma,
                foot_sigma,
                by_height,
            }) => {
                let sigma = own_sigma
                    .hypot(foot_sigma)
                    .hypot(by_height * self.size.relative_sigma);
                sigma.ln()
                    + (FREEDOM + 1.0) / 2.0 * (error * error / (sigma * sigma * FREEDOM)).ln_1p()
            }
            None => NO_FOOT_COST,
        };
        let errors = self.errors(at, &vec![1.0; self.people]);
        errors.into_iter().map(cost).sum::<f64>()
            + at.y * at.y / (2.0 * ROLL_PRIOR_RAD * ROLL_PRIOR_RAD)
    }

    /// The head's error of each box, `None` if its foot is above the horizon; `grown` are the
    /// heights of the people relative to the mean.
    fn errors(&self, at: &Vector3<f64>, grown: &[f64]) -> Vec<Option<HeadError>> {
        let projection = self.projection(at);
        let height_m = at.z.exp();
        let half = HalfDepth::of_size(&self.size);
        let error = |person: &PersonBox| {
            let (foot, head) = box_height::foot_and_head(&person.bounding_box, &projection);
            if foot.slope <= MIN_SLOPE {
                return None;
            }
            // The foot is the near edge of a person, and the head is above the middle.
            let near_m = height_m / foot.slope;
            let drop_m = height_m - self.size.height_m * grown[person.person];
            let head_m = near_m + half.mean_m * foot.depth_factor;
            let by_distance = drop_m / (head_m * head_m);
            let by_height = self.size.height_m / head_m;
            // Relative to the person's height, so that the errors do not depend on the height.
            let step_m = self.size.height_m * grown[person.person] * STEP_SIGMA;
            let foot_m =
                (foot.errors[Source::FootRow as usize] * near_m / foot.slope).hypot(step_m);
            Some(HeadError {
                error: head.slope - drop_m / head_m,
                own_sigma: head.errors[Source::HeadRow as usize].hypot(by_height * GAIT_SIGMA),
                foot_sigma: by_distance * foot_m,
                by_height,
            })
        };
        self.boxes.iter().map(error).collect()
    }

    /// The likeliest values near `at` and `grown` with their covariance: iteratively reweighted
    /// least squares, from which the heights of the people are eliminated (Schur complement).
    fn improved(
        &self,
        mut at: Vector3<f64>,
        mut grown: Vec<f64>,
        weight: impl Fn(f64) -> f64,
    ) -> (Vector3<f64>, Vec<f64>, Matrix3<f64>) {
        let mut covariance = Matrix3::from_element(f64::INFINITY);
        let spread = self.size.relative_sigma.max(MIN_SPREAD).powi(-2);
        for _ in 0..MAX_STEPS {
            let errors = self.errors(&at, &grown);
            let moved: [Vec<Option<HeadError>>; 3] = std::array::from_fn(|axis| {
                self.errors(&(at + Matrix3::identity().column(axis) * STEP), &grown)
            });
            let taller = self.errors(
                &at,
                &grown.iter().map(|grown| grown + STEP).collect::<Vec<_>>(),
            );
            let roll_prior = ROLL_PRIOR_RAD.powi(-2);
            let mut information = Matrix3::from_diagonal(&Vector3::new(0.0, roll_prior, 0.0));
            let mut gradient = Vector3::new(0.0, roll_prior * at.y, 0.0);
            let of_person = |grown: &f64| PersonSums {
                information: spread,
                gradient: spread * (grown - 1.0),
                shared: Vector3::zeros(),
            };
            let mut people: Vec<PersonSums> = grown.iter().map(of_person).collect();
            for (index, PersonBox { person, .. }) in self.boxes.iter().enumerate() {
                let Some(error) = errors[index] else { continue };
                let off = error.in_sigmas(error.own_sigma);
                let change = |moved: HeadError| (moved.in_sigmas(error.own_sigma) - off) / STEP;
                let slopes = Vector3::from_fn(|axis, _| moved[axis][index].map_or(0.0, change));
                let by_height = taller[index].map_or(0.0, change);
                let weight = weight(off);
                information += slopes * slopes.transpose() * weight;
                gradient += slopes * (weight * off);
                let person = &mut people[*person];
                person.information += weight * by_height * by_height;
                person.gradient += weight * by_height * off;
                person.shared += slopes * (weight * by_height);
            }
            for PersonSums {
                information: own,
                gradient: own_gradient,
                shared,
            } in &people
            {
                information -= shared * shared.transpose() / *own;
                gradient -= shared * (own_gradient / own);
            }
            let Some(inverse) = information.try_inverse() else {
                break;
            };
            covariance = inverse;
            let step = inverse * gradient;
            let share = (MAX_STEP / step.amax()).min(1.0);
            for (
                grown,
                PersonSums {
                    information,
                    gradient,
                    shared,
                },
            ) in grown.iter_mut().zip(&people)
            {
                *grown -= share * (gradient - shared.dot(&step)) / information;
            }
            at -= step * share;
            if step.amax() < CONVERGED {
                break;
            }
        }
        (at, grown, covariance)
    }
}

/// Slope below the horizon under which a foot is at no distance.
const MIN_SLOPE: f64 = 1e-3;
/// Cost of a box whose foot is above the horizon: higher than the cost of any other box.
const NO_FOOT_COST: f64 = 10.0;
/// Least relative standard deviation of people's heights.
const MIN_SPREAD: f64 = 1e-3;
/// Ratio of standard deviation and median of the magnitude of normal errors.
const NORMAL_MEDIAN: f64 = 1.4826;
/// Least scale of the errors.
const MIN_SCALE: f64 = 0.2;
/// Tuning of Welsch's weights, which makes them 95 % as good as least squares for normal errors
/// (Holland, Welsch 1977).
const WELSCH: f64 = 2.985;
const MAX_STEPS: usize = 60;
const MAX_STEP: f64 = 0.1;
const CONVERGED: f64 = 1e-6;
/// Step of the numerical derivatives.
const STEP: f64 = 1e-5;

#[cfg(test)]
mod tests;
