//! Where a moving vehicle was when a frame was captured.

use std::collections::VecDeque;
use std::time::Duration;

use crate::geometry::{Pose, wrap_angle};
use crate::time::Timestamp;

/// Longest time between two poses for the vehicle to have gone straight from one to the other.
const MAX_GAP: Duration = Duration::from_secs(1);

/// How long after the newest pose the vehicle is still taken to go on as before.
const MAX_AHEAD: Duration = Duration::from_millis(300);

/// How many poses are kept: some seconds at the 100 Hz of an inertial unit.
const KEPT: usize = 512;

/// A vehicle's latest poses, by the clock that stamps its frames.
///
/// Between two poses the vehicle moves evenly, turning the shorter way; shortly after the newest it goes on so.
#[derive(Debug, Clone, Default)]
pub struct Motion {
    poses: VecDeque<(Timestamp, Pose)>,
}

impl Motion {
    /// Takes the pose at a time; false, and not taken, if it is not later than all before.
    pub fn take(&mut self, at: Timestamp, pose: Pose) -> bool {
        let is_later = self.poses.back().is_none_or(|(last, _)| at > *last);
        if is_later {
            if self.poses.len() == KEPT {
                self.poses.pop_front();
            }
            self.poses.push_back((at, pose));
        }
        is_later
    }

    /// The pose at a time; none when no pose is known near it.
    pub fn at(&self, time: Timestamp) -> Option<Pose> {
        let after = self.poses.partition_point(|(at, _)| *at < time);
        let Some((next_at, next)) = self.poses.get(after) else { return self.ahead(time) };
        if *next_at == time {
            return Some(*next);
        }
        let (last_at, last) = self.poses.get(after.checked_sub(1)?)?;
        let gap = next_at.since(*last_at);
        (gap <= MAX_GAP).then(|| between(last, next, time.since(*last_at).as_secs_f64() / gap.as_secs_f64()))
    }

    /// The pose after the newest.
    fn ahead(&self, time: Timestamp) -> Option<Pose> {
        let (last_at, last) = self.poses.back()?;
        let ahead = time.since(*last_at);
        if ahead > MAX_AHEAD {
            return None;
        }
        let before = self.poses.len().checked_sub(2).and_then(|index| self.poses.get(index));
        let Some((before_at, before)) = before else { return Some(*last) };
        let gap = last_at.since(*before_at);
        let share = 1.0 + ahead.as_secs_f64() / gap.as_secs_f64();
        Some(if gap <= MAX_GAP { between(before, last, share) } else { *last })
    }
}

/// The pose at a share of the way from one to another; beyond 1 past the other.
fn between(from: &Pose, to: &Pose, share: f64) -> Pose {
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

    fn motion(poses: &[(u64, f64, f64)]) -> Motion {
        let mut motion = Motion::default();
        for (at, x_m, heading_rad) in poses {
            assert!(motion.take(ms(*at), Pose::new(*x_m, 0.0, *heading_rad)));
        }
        motion
    }

    #[test]
    fn a_vehicle_moves_evenly_between_two_poses_and_goes_on_for_a_moment() {
        let motion = motion(&[(0, 0.0, 0.0), (100, 1.0, 0.2)]);
        for (at, x_m, heading_rad) in [(0, 0.0, 0.0), (25, 0.25, 0.05), (100, 1.0, 0.2), (150, 1.5, 0.3)] {
            let pose = motion.at(ms(at)).unwrap();
            assert!((pose.position.x - x_m).abs() < 1e-9 && (pose.heading_rad - heading_rad).abs() < 1e-9, "{pose:?}");
        }
        assert_eq!(motion.at(ms(500)), None, "too long ago");
    }

    #[test]
    fn it_turns_the_shorter_way() {
        let pose = motion(&[(0, 0.0, PI - 0.1), (100, 0.0, 0.1 - PI)]).at(ms(50)).unwrap();
        assert!((pose.heading_rad.abs() - PI).abs() < 1e-9, "{pose:?}");
    }

    #[test]
    fn where_no_pose_is_near_there_is_none() {
        assert_eq!(Motion::default().at(ms(0)), None);
        let motion = motion(&[(1000, 0.0, 0.0), (4000, 9.0, 0.0), (4100, 9.5, 0.0)]);
        assert_eq!(motion.at(ms(900)), None, "before all");
        assert_eq!(motion.at(ms(2500)), None, "in a gap");
        assert_eq!(motion.at(ms(4100)).unwrap().position.x, 9.5);
    }

    #[test]
    fn poses_are_taken_in_order_and_memory_is_bounded() {
        let mut motion = motion(&[(100, 0.0, 0.0)]);
        assert!(!motion.take(ms(100), Pose::new(5.0, 0.0, 0.0)));
        assert!(!motion.take(ms(50), Pose::new(5.0, 0.0, 0.0)));
        (200..5000).for_each(|at| assert!(motion.take(ms(at), Pose::new(0.0, 0.0, 0.0))));
        assert_eq!(motion.poses.len(), KEPT);
    }
}
