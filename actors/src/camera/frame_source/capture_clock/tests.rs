use super::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const PERIOD: Duration = Duration::from_millis(50);

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

/// A frame every 50 ms, which takes 30 ms to arrive, and up to 40 ms more.
struct Frame {
    position: Duration,
    captured_at: Timestamp,
    arrived_at: Timestamp,
}

fn frames(count: u32) -> impl Iterator<Item = Frame> {
    (0..count).map(|number| {
        let position = PERIOD * (number + 1);
        let captured_at = START + position;
        Frame {
            position,
            captured_at,
            arrived_at: captured_at + ms(30) + ms(u64::from(number * 7 % 5) * 10),
        }
    })
}

#[test]
fn late_frame_keeps_stamped_time() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(100) {
        let time = clock.time(Some(FrameStamp::Time(frame.captured_at)), frame.arrived_at);
        assert_eq!(time, frame.captured_at);
        assert_eq!(clock.source(), TimeSource::Stamp);
    }
}

#[test]
fn positions_remove_jitter_of_arrival() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(1000) {
        let stamp = FrameStamp::Position(frame.position);
        let time = clock.time(Some(stamp), frame.arrived_at);
        assert_eq!(time, frame.captured_at + ms(30));
        assert_eq!(clock.source(), TimeSource::Position);
    }
}

#[test]
fn wrong_camera_clock_gives_spacing_only() {
    for wrong_s in [-86_400.0, -1.2, 0.1, 3600.0] {
        let mut clock = CaptureClock::new(None);
        for frame in frames(100) {
            let stated = frame.captured_at.shifted((wrong_s * 1e6) as i64);
            let time = clock.time(Some(FrameStamp::Time(stated)), frame.arrived_at);
            assert_eq!(time, frame.captured_at + ms(30), "{wrong_s}");
            assert_eq!(clock.source(), TimeSource::WrongStamp);
        }
    }
}

#[test]
fn configured_latency_replaces_stated_one() {
    let mut clocks = [(); 3].map(|()| CaptureClock::new(Some(0.2)));
    for frame in frames(100) {
        let stamps = [
            Some(FrameStamp::Time(frame.captured_at)),
            Some(FrameStamp::Position(frame.position)),
            None,
        ];
        let [time, position, none] = [0, 1, 2].map(|i| clocks[i].time(stamps[i], frame.arrived_at));
        assert_eq!(time, frame.captured_at + ms(30) - ms(200));
        assert_eq!(position, time);
        assert_eq!(none, frame.arrived_at - ms(200));
    }
}

#[test]
fn clock_without_progress_gives_arrival() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(100) {
        let time = clock.time(Some(FrameStamp::Position(ms(7))), frame.arrived_at);
        assert_eq!(time, frame.arrived_at);
    }
}

#[test]
fn restarted_positions_start_anew() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(100) {
        clock.time(
            Some(FrameStamp::Position(frame.position + ms(9_000))),
            frame.arrived_at,
        );
    }
    for frame in frames(100) {
        let arrived_at = frame.arrived_at + ms(60_000);
        let time = clock.time(Some(FrameStamp::Position(frame.position)), arrived_at);
        assert_eq!(time, frame.captured_at + ms(60_030));
    }
}

#[test]
fn drifting_camera_clock_is_followed() {
    for drift in [-1e-4, 1e-4] {
        let mut clock = CaptureClock::new(None);
        let mut worst_us = 0;
        for frame in frames(20 * 3600) {
            let stamp = FrameStamp::Position(frame.position.mul_f64(1.0 + drift));
            let time = clock.time(Some(stamp), frame.arrived_at);
            let error_us = time.micros_from(frame.captured_at + ms(30));
            worst_us = error_us.abs().max(worst_us);
        }
        assert!(worst_us < 2500, "{worst_us} us at {drift}");
    }
}

/// Frames of a stall of 1.6 s arrive together after it.
#[test]
fn burst_keeps_its_spacing() {
    for is_time in [true, false] {
        let mut clock = CaptureClock::new(None);
        for frame in frames(200) {
            let stall = Duration::from_secs(5)..Duration::from_millis(6600);
            let arrived_at = if stall.contains(&frame.position) {
                START + stall.end + ms(150)
            } else {
                frame.arrived_at
            };
            let (stamp, way) = if is_time {
                (FrameStamp::Time(frame.captured_at), ms(0))
            } else {
                (FrameStamp::Position(frame.position), ms(30))
            };
            let time = clock.time(Some(stamp), arrived_at);
            assert_eq!(time, frame.captured_at + way);
        }
    }
}

/// A stream that pauses for 5 s, while its positions stand still.
#[test]
fn paused_positions_recover() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(100) {
        clock.time(Some(FrameStamp::Position(frame.position)), frame.arrived_at);
    }
    for frame in frames(300).skip(100) {
        let arrived_at = frame.arrived_at + ms(5000);
        let time = clock.time(Some(FrameStamp::Position(frame.position)), arrived_at);
        if frame.position > Duration::from_millis(7500) {
            let error_us = time.micros_from(frame.captured_at + ms(5030));
            assert!(
                error_us.abs() <= 120_000,
                "{error_us} us at {:?}",
                frame.position
            );
        }
    }
}

#[test]
fn coarse_stamps_give_arrival() {
    let mut clock = CaptureClock::new(None);
    for frame in frames(100).skip(1) {
        let second = Timestamp(frame.captured_at.micros() / 1_000_000 * 1_000_000);
        let time = clock.time(Some(FrameStamp::Time(second)), frame.arrived_at);
        if frame.position > PERIOD * 2 {
            assert_eq!(time, frame.arrived_at);
            assert_eq!(clock.source(), TimeSource::Arrival);
        }
    }
}

/// A clock with 40 % of the right rate.
#[test]
fn slow_positions_err_by_seconds() {
    let limit = Duration::from_micros(MAX_DELAY_US.unsigned_abs()) + MAX_BURST;
    let mut clock = CaptureClock::new(None);
    for frame in frames(1000) {
        let stamp = FrameStamp::Position(frame.position.mul_f64(0.4));
        let time = clock.time(Some(stamp), frame.arrived_at);
        let early = frame.arrived_at.since(time);
        assert!(early <= limit, "{early:?}");
    }
}

/// A clock that falls behind by 200 millionths passes the limit of plausible delays.
#[test]
fn times_of_frames_never_go_back() {
    let mut clock = CaptureClock::new(None);
    let mut last = Timestamp::default();
    let mut arrived_at = Timestamp::default();
    for frame in frames(20 * 600) {
        arrived_at = frame.arrived_at.max(arrived_at);
        let behind = ms(940) + frame.position.mul_f64(2e-4);
        let stamp = FrameStamp::Time(frame.captured_at - behind);
        let time = clock.time(Some(stamp), arrived_at);
        assert!(time >= last && time <= arrived_at);
        last = time;
    }
}
