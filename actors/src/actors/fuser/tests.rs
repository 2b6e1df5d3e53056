//! The state from which a new leader continues.

use ecod::aggregator::FusionConfig;
use ecod::leadership::{Leadership, Position};
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{PerceivedObject, WirePose};

use super::*;
use crate::actors::follower::{Follower, FollowerArguments};
use crate::messages::actor_slot::listening;
use crate::messages::follower::FollowerMessage;
use crate::messages::newest::Newest;

fn epoch(term: u64, leader: &'static str) -> Epoch {
    Epoch::new(term, NodeName::from_static(leader))
}

fn spans() -> Spans {
    Spans::new(NodeName::from_static("lot"), NodeName::from_static("gauss"))
}

fn map(epoch: &Epoch, round: u64, received_at: Timestamp) -> FollowerMessage {
    let map = Arc::new(GlobalMap::new(epoch, round, Timestamp(0)));
    FollowerMessage::HandleMap {
        delivery: Delivery::local(map, received_at),
    }
}

fn standby() -> FuserState {
    FuserState::new(FuserArguments {
        aggregator: Aggregator::new_standby(FusionConfig::default(), Vec::new(), Timestamp(0)),
        report_queue: LatestReportQueue::new(1_024),
        newest: None,
        recording: LogSender::default(),
        clock: CellClock::default(),
        gateway: ActorSlot::default(),
        keeper: ActorSlot::default(),
        counters: Arc::default(),
        spans: spans(),
    })
}

#[tokio::test]
async fn forged_map_replaces_no_leader() {
    let elected = Leadership {
        position: Position::Following,
        epoch: Some(epoch(7, "edge")),
        standby: None,
        term: 7,
        is_deserted: false,
        is_yielding: false,
    };
    let seeking = Leadership {
        term: 7,
        ..Leadership::default()
    };
    for leadership in [elected, seeking] {
        let (fuser, mut messages) = listening::slot().await;
        let newest = Newest::default();
        let arguments = FollowerArguments {
            newest: newest.clone(),
            log: None,
            cell: NodeName::from_static("cell"),
            present_cell: tokio::sync::watch::channel(NodeName::from_static("cell")).1,
            recording: LogSender::default(),
            saved_term: 0,
            leadership: tokio::sync::watch::channel(leadership.clone()).1,
            election: ActorSlot::default(),
            fuser: fuser.clone(),
            door: Default::default(),
            clock: CellClock::default(),
            counters: Arc::default(),
            spans: spans(),
        };
        let (follower, _) = Actor::spawn(None, Follower, arguments).await.unwrap();
        for round in 1..=3 {
            follower
                .cast(map(&epoch(7, "edge"), round, Timestamp(round)))
                .unwrap();
            follower
                .cast(map(&epoch(u64::MAX, "gauss"), round, Timestamp(round)))
                .unwrap();
        }
        // The filter accepts a publisher that keeps publishing; a new leader does not continue from
        // such a map.
        follower
            .cast(map(&epoch(u64::MAX, "gauss"), 4, Timestamp(600_000)))
            .unwrap();
        follower.drain_and_wait(None).await.unwrap();
        fuser.get().unwrap().drain_and_wait(None).await.unwrap();

        let mut fuser = standby();
        let mut maps = 0;
        while let Ok(FuserMessage::HandleMap { map, received_at }) = messages.try_recv() {
            fuser.on_map(map, received_at);
            maps += 1;
        }
        assert_eq!(
            newest.map.borrow().as_ref().map(|newest| newest.map.epoch),
            Some(u64::MAX)
        );
        let kept = fuser.last_map.map(|(map, _)| (map.epoch, map.round));
        assert_eq!((kept, maps), (Some((7, 3)), 3), "{leadership:?}");
    }
}

#[tokio::test]
async fn expelled_leaders_map_is_dropped() {
    let mut fuser = standby();
    let FollowerMessage::HandleMap { delivery } = map(&epoch(7, "edge"), 1, Timestamp(1)) else {
        panic!("a map")
    };
    fuser.on_map(Arc::clone(&delivery.message), Timestamp(1));
    fuser.expel(&NodeName::from_static("gauss"));
    assert!(fuser.last_map.is_some(), "another's");
    fuser.expel(&NodeName::from_static("edge"));
    assert!(fuser.last_map.is_none());
}

/// The fuser's current troubles, as their subjects, kinds and causes.
fn troubles(fuser: &FuserState) -> Vec<(Option<String>, String, String)> {
    let all = fuser.counters.troubles().present().into_iter();
    all.map(|trouble| (trouble.about, trouble.kind, trouble.cause))
        .collect()
}

fn take(
    fuser: &mut FuserState,
    mut report: ObjectReport,
    received_at: Timestamp,
    location: Option<&str>,
) {
    report.seen = location.map(|id| vec![id.into()]);
    let message = QueuedReport {
        kind: ReportKind::Detections,
        report: Arc::new(report),
    };
    fuser.on_delivery(&Delivery::local(message, received_at));
}

/// A wrong clock is reported with its error, both while the reports are refused and later, when
/// they are corrected.
#[test]
fn wrong_clock_is_reported() {
    let mut fuser = standby();
    let late = NodeName::from_static("late");
    for n in 1..=20 {
        let received_at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        let report = ObjectReport::new(late.clone(), n, received_at + Duration::from_secs(5));
        take(&mut fuser, report, received_at, None);
        let kinds: Vec<_> = troubles(&fuser)
            .into_iter()
            .map(|(_, kind, _)| kind)
            .collect();
        match n {
            ..=5 => assert!(kinds.is_empty(), "{n}: {kinds:?}"),
            7..=9 => assert_eq!(kinds, ["untimely"], "{n}"),
            _ => {}
        }
    }
    let reported = troubles(&fuser);
    let about = Some("late".to_owned());
    let corrected = "its clock is 5.0 s ahead; its reports are corrected for this";
    assert_eq!(
        reported,
        [(about, "clock_off".into(), corrected.into())],
        "refused no longer"
    );
}

#[test]
fn time_in_seconds_is_reported() {
    let mut fuser = standby();
    for n in 1..=20 {
        let received_at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        let report = ObjectReport::new(
            NodeName::from_static("late"),
            n,
            Timestamp(received_at.micros() / 1_000_000),
        );
        take(&mut fuser, report, received_at, None);
    }
    let reported = troubles(&fuser);
    assert!(
        reported
            .iter()
            .any(|(_, _, cause)| cause.contains("`captured_at_us` looks like seconds")),
        "{reported:?}"
    );
}

/// A node dates its reports in the cell's time, so its clock does not make them late.
#[test]
fn late_reports_blame_no_clock() {
    let mut fuser = standby();
    for n in 1..=20 {
        let received_at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        let captured_at = received_at - Duration::from_secs(3);
        let mut report = ObjectReport::new(NodeName::from_static("late"), n, captured_at);
        report.clock_error_us = Some(1000);
        take(&mut fuser, report, received_at, None);
    }
    let troubles = fuser.counters.troubles().present();
    let [trouble] = &troubles[..] else {
        panic!("{troubles:?}")
    };
    assert_eq!(trouble.kind, "untimely");
    assert_eq!(
        trouble.cause,
        "refused, its reports arrive 3.0 s after the capture"
    );
    assert_eq!(trouble.remedy, LATE_REMEDY);
}

/// Where objects are tracked, they may be anywhere near the locations: three metres, but not three
/// hundred.
#[test]
fn vehicle_in_centimetres_is_reported() {
    let mut fuser = standby();
    let slot = toml::from_str::<LandmarkConfig>("id = \"slot-0\"\nx_m = 30\ny_m = 0").unwrap();
    let mut config = FusionConfig::default();
    config.tracks.mode = ecod::tracking::TracksMode::On;
    fuser.aggregator = Aggregator::new_standby(config, vec![(&slot).into()], Timestamp(0));
    for n in 1..=120 {
        let at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        for (name, x_m) in [("watson", 300.0), ("euclid", 3.0)] {
            let mut report = ObjectReport::new(NodeName::from_static(name), n, at);
            report.objects = vec![PerceivedObject::new("car", 0.9, x_m, 0.0)];
            take(&mut fuser, report, at, None);
        }
    }
    let reported: Vec<_> = troubles(&fuser)
        .into_iter()
        .map(|(about, kind, _)| (about.unwrap_or_default(), kind))
        .collect();
    assert_eq!(reported, [("watson".to_owned(), "misplaced".to_owned())]);
}

/// Two programs with one name are reported; a program that restarts is not.
#[test]
fn two_same_named_programs_reported() {
    for (senders, is_told) in [(1, false), (2, true)] {
        let mut fuser = standby();
        for n in 0..60 {
            let at = Timestamp(1_795_000_000_000_000 + n * 50_000);
            let seq = if senders == 2 {
                n / 2 + 1000 * (n % 2)
            } else {
                1000 + n % 30
            };
            take(
                &mut fuser,
                ObjectReport::new(NodeName::from_static("watson"), seq, at),
                at,
                None,
            );
        }
        let reported = troubles(&fuser);
        assert_eq!(
            reported.iter().any(|(_, kind, _)| kind == "name_taken"),
            is_told,
            "{reported:?}"
        );
    }
}

/// A vehicle that reports in centimetres has no object at a landmark, or objects far from its
/// camera; it is reported independent of other vehicles.
#[test]
fn unplaceable_vehicle_is_reported() {
    let mut fuser = standby();
    let slot = toml::from_str::<LandmarkConfig>("id = \"slot-0\"\nx_m = 3\ny_m = 0").unwrap();
    fuser.aggregator =
        Aggregator::new_standby(FusionConfig::default(), vec![(&slot).into()], Timestamp(0));
    let mut reported = Vec::new();
    for n in 1..=120 {
        let at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        for (name, scale) in [("watson", 100.0), ("euclid", 1.0)] {
            let mut report = ObjectReport::new(NodeName::from_static(name), n, at);
            report.objects = vec![PerceivedObject::new("car", 0.9, 3.0 * scale, 0.0)];
            take(&mut fuser, report, at, None);
        }
        let mut gauss = ObjectReport::new(NodeName::from_static("gauss"), n, at);
        gauss.pose = Some(WirePose::new(0.0, 0.0, 0.0));
        gauss.objects = vec![
            PerceivedObject::new("car", 0.9, 3.0, 0.0),
            PerceivedObject::new("car", 0.9, 800.0, 0.0),
        ];
        take(&mut fuser, gauss, at, None);
        reported = troubles(&fuser);
        assert_eq!(
            reported.len(),
            if n <= 100 { 1 } else { 2 },
            "{n}: {reported:?}"
        );
    }
    let of = |name: &str, cause: &str| {
        (
            Some(name.to_owned()),
            "misplaced".to_owned(),
            cause.to_owned(),
        )
    };
    let far = of("gauss", "an object of its report is 800 m from its pose");
    assert_eq!(
        reported,
        [
            far,
            of(
                "watson",
                "none of its objects is at a known location, or near one"
            )
        ]
    );
}

/// A vehicle that states that it does not move, and stands within the error of its pose, is not
/// reported.
#[test]
fn moving_vehicle_claiming_rest_reported() {
    let mut fuser = standby();
    for n in 1..=60 {
        let at = Timestamp(1_795_000_000_000_000 + n * 100_000);
        for (name, x_m, moving) in [
            ("watson", n as f64, false),
            ("euclid", (n % 3) as f64, false),
            ("gauss", n as f64, true),
        ] {
            let mut report = ObjectReport::new(NodeName::from_static(name), n, at);
            report.pose = Some(WirePose::new(x_m, 0.0, 0.0));
            report.moving = Some(moving);
            take(&mut fuser, report, at, None);
        }
    }
    let cause = "it states `moving` = false, and its pose has moved by more than 25 m";
    assert_eq!(
        troubles(&fuser),
        [(
            Some("watson".to_owned()),
            "misplaced".to_owned(),
            cause.to_owned()
        )]
    );
}

/// The vehicle of an entry that the map leaves out is named, with the reason.
#[test]
fn vehicles_missing_from_map_reported() {
    let fuser = standby();
    let entry = |reason, vehicle: &'static str| InvalidEntry {
        reason,
        contributors: vec![NodeName::from_static(vehicle)],
    };
    fuser.report_left_out(&[
        entry(RejectReason::TooManyObjects, "mallory"),
        entry(RejectReason::NotFinite, "watson"),
    ]);
    let of = |name: &str, kind: &str, cause: &str| {
        (Some(name.to_owned()), kind.to_owned(), cause.to_owned())
    };
    let share = "the map leaves out objects that only it reports: it has more than its share";
    let bounds =
        "the map leaves out an object of its reports, which would be out of bounds: not finite";
    assert_eq!(
        troubles(&fuser),
        [
            of("mallory", "overload", share),
            of("watson", "misplaced", bounds)
        ]
    );
    assert_eq!(fuser.counters.events(Event::EntryLeftOut), 2);
}

#[test]
fn one_sided_landmarks_are_reported() {
    let now = Timestamp(1_795_000_000_000_000);
    let report = |seq: u64| ObjectReport::new(NodeName::from_static("euclid"), seq, now);
    let mut without = standby();
    take(&mut without, report(1), now, None);
    assert_eq!(troubles(&without), []);
    take(&mut without, report(2), now, Some("slot-0"));
    let cause = "euclid names known locations, such as “slot-0”, and this node has none";
    assert_eq!(
        troubles(&without),
        [(None, "no_locations".into(), cause.into())]
    );

    let mut with = standby();
    let slot = toml::from_str::<LandmarkConfig>("id = \"slot-0\"\nx_m = 0\ny_m = 0").unwrap();
    with.aggregator =
        Aggregator::new_standby(FusionConfig::default(), vec![(&slot).into()], Timestamp(0));
    take(&mut with, report(1), now, Some("slot-0"));
    assert_eq!(troubles(&with), []);
    take(&mut with, report(2), now, Some("slot-9"));
    let cause = "names the location “slot-9”, which this node does not have";
    let unknown = [(
        Some("euclid".to_owned()),
        "unknown_location".to_owned(),
        cause.to_owned(),
    )];
    assert_eq!(troubles(&with), unknown);

    // Votes for a location that is not configured are ignored, and this is reported too.
    let mut votes = standby();
    votes.aggregator =
        Aggregator::new_standby(FusionConfig::default(), vec![(&slot).into()], Timestamp(0));
    let seen = Some(vec!["slot-9".into()]);
    let message = QueuedReport {
        kind: ReportKind::VoteDetections,
        report: Arc::new(ObjectReport { seen, ..report(1) }),
    };
    votes.on_delivery(&Delivery::local(message, now));
    assert_eq!(troubles(&votes), unknown);
}
