//! The pose of a moving vehicle at the capture time of a frame.

use std::collections::VecDeque;
use std::time::Duration;

use crate::model::geometry::{Pose, wrap_angle};
use crate::model::time::Timestamp;

/// Maximum time between two poses for interpolation between them.
const MAX_GAP: Duration = Duration::from_secs(1);

/// Maximum time of extrapolation after the newest pose.
const MAX_AHEAD: Duration = Duration::from_millis(300);

/// Maximum number of kept poses: some seconds at the 100 Hz of an inertial unit.
const MAX_POSES: usize = 512;

/// A vehicle's latest poses, by the clock that stamps its frames.
///
/// Between two poses it interpolates linearly and turns the shorter way; shortly after the newest
/// it extrapolates.
#[derive(Debug, Clone, Default)]
pub struct PoseHistory {
    poses: VecDeque<(Timestamp, Pose)>,
}

impl PoseHistory {
    /// Appends a pose; false, and without effect, if it is not later than all others.
    pub fn push(&mut self, at: Timestamp, pose: Pose) -> bool {
        let is_later = self.poses.back().is_none_or(|(last, _)| at > *last);
        if is_later {
            if self.poses.len() == MAX_POSES {
                self.poses.pop_front();
            }
            self.poses.push_back((at, pose));
        }
        is_later
    }

    /// The pose at a time; `None` if there is no pose near that time.
    pub fn at(&self, time: Timestamp) -> Option<Pose> {
        let after = self.poses.partition_point(|(at, _)| *at < time);
        let Some((next_at, next)) = self.poses.get(after) else {
            return self.extrapolate(time);
        };
        if *next_at == time {
            return Some(*next);
        }
        let (last_at, last) = self.poses.get(after.checked_sub(1)?)?;
        let gap = next_at.since(*last_at);
        (gap <= MAX_GAP).then(|| {
            interpolate(
                last,
                next,
                time.since(*last_at).as_secs_f64() / gap.as_secs_f64(),
            )
        })
    }

    /// The pose at a time after the newest.
    fn extrapolate(&self, time: Timestamp) -> Option<Pose> {
        let (last_at, last) = self.poses.back()?;
        let ahead = time.since(*last_at);
        if ahead > MAX_AHEAD {
            return None;
        }
        let before = self
            .poses
            .len()
            .checked_sub(2)
            .and_then(|index| self.poses.get(index));
        let Some((before_at, before)) = before else {
            return Some(*last);
        };
        let gap = last_at.since(*before_at);
        let share = 1.0 + ahead.as_secs_f64() / gap.as_secs_f64();
        Some(if gap <= MAX_GAP {
            interpolate(before, last, share)
        } else {
            *last
        })
    }
}

/// The pose at a share of the way from one pose to another; a share above 1 extrapolates.
fn interpolate(from: &Pose, to: &Pose, share: f64) -> Pose {
    let turned = wrap_angle(to.heading_rad - from.heading_rad);
    Pose {
        position: from.position + (to.position - from.position) * share,
        heading_rad: wrap_angle(from.heading_rad + turned * share),
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn ms(n: u64) -> Timestamp {
        Timestamp(1_732_154_400_000_000 + 1000 * n)
    }

    fn history(poses: &[(u64, f64, f64)]) -> PoseHistory {
        let mut history = PoseHistory::default();
        for (at, x_m, heading_rad) in poses {
            assert!(history.push(ms(*at), Pose::new(*x_m, 0.0, *heading_rad)));
        }
        history
    }

    #[test]
    fn pose_is_interpolated_and_briefly_extrapolated() {
        let history = history(&[(0, 0.0, 0.0), (100, 1.0, 0.2)]);
        for (at, x_m, heading_rad) in [
            (0, 0.0, 0.0),
            (25, 0.25, 0.05),
            (100, 1.0, 0.2),
            (150, 1.5, 0.3),
        ] {
            let pose = history.at(ms(at)).unwrap();
            assert!(
                (pose.position.x - x_m).abs() < 1e-9
                    && (pose.heading_rad - heading_rad).abs() < 1e-9,
                "{pose:?}"
            );
        }
        assert_eq!(history.at(ms(500)), None, "too long ago");
    }

    #[test]
    fn it_turns_the_shorter_way() {
        let pose = history(&[(0, 0.0, PI - 0.1), (100, 0.0, 0.1 - PI)])
            .at(ms(50))
            .unwrap();
        assert!((pose.heading_rad.abs() - PI).abs() < 1e-9, "{pose:?}");
    }

    #[test]
    fn distant_times_have_no_pose() {
        assert_eq!(PoseHistory::default().at(ms(0)), None);
        let history = history(&[(1000, 0.0, 0.0), (4000, 9.0, 0.0), (4100, 9.5, 0.0)]);
        assert_eq!(history.at(ms(900)), None, "before all");
        assert_eq!(history.at(ms(2500)), None, "in a gap");
        assert_eq!(history.at(ms(4100)).unwrap().position.x, 9.5);
    }

    #[test]
    fn poses_are_ordered_and_bounded() {
        let mut history = history(&[(100, 0.0, 0.0)]);
        assert!(!history.push(ms(100), Pose::new(5.0, 0.0, 0.0)));
        assert!(!history.push(ms(50), Pose::new(5.0, 0.0, 0.0)));
        (200..5000).for_each(|at| assert!(history.push(ms(at), Pose::new(0.0, 0.0, 0.0))));
        assert_eq!(history.poses.len(), MAX_POSES);
    }
}
