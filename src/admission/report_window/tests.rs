use super::Admitted::{InOrder, OutOfOrder};
use super::*;

const NOON: u64 = 1_732_154_400_000_000;

fn report(node: &str, captured_us: u64) -> ObjectReport {
    ObjectReport {
        objects: vec![],
        ..ObjectReport::new(NodeName::new(node).unwrap(), 0, Timestamp(captured_us))
    }
}

fn window() -> ReportWindow {
    ReportWindow::new(WindowConfig::default())
}

#[test]
fn takes_reports_once_in_order() {
    let mut window = window();
    let now = Timestamp(NOON + 10_000);
    assert_eq!(
        window.admit(&report("a", NOON), now),
        Ok(InOrder(Timestamp(NOON)))
    );
    assert_eq!(
        window.admit(&report("a", NOON), now),
        Err(RejectReason::OutOfOrder)
    );
    assert_eq!(
        window.admit(&report("a", NOON - 1), now),
        Ok(OutOfOrder(Timestamp(NOON - 1)))
    );
    assert_eq!(
        window.admit(&report("a", NOON - 1), now),
        Err(RejectReason::OutOfOrder)
    );
    assert_eq!(
        window.admit(&report("b", NOON - 1), now),
        Ok(InOrder(Timestamp(NOON - 1)))
    );
}

#[test]
fn overtaken_report_is_no_duplicate() {
    let mut window = window();
    let now = Timestamp(NOON + 810_000);
    for n in 1..=40 {
        assert!(matches!(
            window.admit(&report("a", NOON + n * 20_000), now),
            Ok(InOrder(_))
        ));
    }
    let admitted =
        |window: &mut ReportWindow, n: u64| window.admit(&report("a", NOON + n * 10_000), now);
    assert_eq!(
        admitted(&mut window, 79),
        Ok(OutOfOrder(Timestamp(NOON + 790_000)))
    );
    assert_eq!(admitted(&mut window, 79), Err(RejectReason::OutOfOrder));
    assert_eq!(
        admitted(&mut window, 31),
        Ok(OutOfOrder(Timestamp(NOON + 310_000)))
    );
    for n in [1, 2, 12] {
        assert_eq!(
            admitted(&mut window, n),
            Err(RejectReason::OutOfOrder),
            "whether {n} came before is unknown"
        );
    }
    assert_eq!(
        window.admit(&report("a", NOON), Timestamp(NOON + 1_100_000)),
        Err(RejectReason::Stale)
    );
}

#[test]
fn tomorrow_and_yesterday_are_rejected() {
    let mut window = window();
    let day = 86_400_000_000;
    assert_eq!(
        window.admit(&report("a", NOON + day), Timestamp(NOON)),
        Err(RejectReason::FromTheFuture)
    );
    assert_eq!(
        window.admit(&report("a", NOON - day), Timestamp(NOON)),
        Err(RejectReason::Stale)
    );
    assert_eq!(
        window.admit(&report("a", u64::MAX), Timestamp(NOON)),
        Err(RejectReason::FromTheFuture)
    );
    assert_eq!(
        window.admit(&report("a", 0), Timestamp(NOON)),
        Err(RejectReason::Stale)
    );
}

#[test]
fn fast_clock_is_corrected() {
    let mut window = window();
    for step in 0..20 {
        let sent = NOON + step * 100_000;
        let admitted = window
            .admit(&report("fast", sent + 1_500_000), Timestamp(sent + 2_000))
            .unwrap();
        assert_eq!(
            admitted,
            InOrder(Timestamp(sent + 2_000)),
            "the fastest transit counts as none"
        );
    }
    let late = NOON + 2_000_000;
    let admitted = window
        .admit(&report("fast", late + 1_500_000), Timestamp(late + 302_000))
        .unwrap();
    assert_eq!(
        admitted,
        InOrder(Timestamp(late + 2_000)),
        "queueing does not move the capture time"
    );
}

#[test]
fn invented_parts_take_no_room() {
    let mut window = window();
    let admitted = (0..100)
        .filter(|n| {
            window
                .admit(&report(&format!("a--{n}"), NOON), Timestamp(NOON))
                .is_ok()
        })
        .count();
    assert_eq!(admitted, MAX_PARTS);
    for other in ["a", "a-", "b", "b--1"] {
        assert!(
            window.admit(&report(other, NOON), Timestamp(NOON)).is_ok(),
            "{other}"
        );
    }
    let later = NOON + 11_000_000;
    assert!(
        window
            .admit(&report("a--100", later), Timestamp(later))
            .is_ok(),
        "silent parts make room"
    );
}

/// Reports every 100 ms with 2 ms of transit; the numbered one is stamped `ahead_us` ahead. Returns
/// which of them are admitted in order.
fn admitted_around_a_wrong_stamp(wrong: u64, ahead_us: u64) -> Vec<bool> {
    let mut window = window();
    let admit = |n: u64| {
        let stamp = NOON + n * 100_000 + if n == wrong { ahead_us } else { 0 };
        let admitted = window.admit(&report("a", stamp), Timestamp(NOON + n * 100_000 + 2_000));
        matches!(admitted, Ok(InOrder(_)))
    };
    (0..200).map(admit).collect()
}

#[test]
fn wrong_stamp_silences_one_second() {
    for wrong in [0, 1, 2, 50, 101] {
        for ahead_us in [100_000, 400_000, 600_000, 1_000_000, 1_900_000] {
            let admitted = admitted_around_a_wrong_stamp(wrong, ahead_us);
            let lost = admitted.iter().filter(|admitted| !**admitted).count();
            assert!(
                lost <= 10,
                "report {wrong}, {ahead_us} µs ahead: {lost} reports lost"
            );
        }
    }
}

#[test]
fn forward_clock_is_followed() {
    let mut window = window();
    let sent = |n: u64| NOON + n * 100_000;
    for n in 0..10 {
        assert!(
            window
                .admit(&report("a", sent(n)), Timestamp(sent(n) + 2_000))
                .is_ok()
        );
    }
    let first = report("a", sent(10) + 1_500_000);
    for transit_us in [2_000, 3_000] {
        let received = Timestamp(sent(10) + transit_us);
        assert_eq!(
            window.admit(&first, received),
            Err(RejectReason::FromTheFuture),
            "over two links"
        );
    }
    for n in 11..20 {
        let received = Timestamp(sent(n) + 2_000);
        assert_eq!(
            window.admit(&report("a", sent(n) + 1_500_000), received),
            Ok(InOrder(received))
        );
    }
}

#[test]
fn synchronised_late_report_is_stale() {
    let mut window = window();
    assert!(
        window
            .admit(&report("a", NOON), Timestamp(NOON + 5_000))
            .is_ok()
    );
    let held_back = window.admit(&report("a", NOON + 100_000), Timestamp(NOON + 1_200_000));
    assert_eq!(held_back, Err(RejectReason::Stale));
}

#[test]
fn backward_clock_is_accepted_again() {
    let config = WindowConfig {
        max_clock_offset_s: 10.0,
        ..WindowConfig::default()
    };
    let mut window = ReportWindow::new(config);
    assert!(
        window
            .admit(&report("a", NOON + 9_000_000), Timestamp(NOON))
            .is_ok()
    );
    assert!(
        window
            .admit(&report("a", NOON - 9_000_000), Timestamp(NOON + 100_000))
            .is_ok()
    );
}

#[test]
fn vehicles_are_bounded_evicting_silent() {
    let mut window = ReportWindow::new(WindowConfig {
        max_vehicles: 2,
        ..WindowConfig::default()
    });
    for node in ["a", "b"] {
        assert!(window.admit(&report(node, NOON), Timestamp(NOON)).is_ok());
    }
    assert_eq!(
        window.admit(&report("c", NOON), Timestamp(NOON)),
        Err(RejectReason::TooManyVehicles)
    );
    let later = NOON + 11_000_000;
    assert!(window.admit(&report("c", later), Timestamp(later)).is_ok());
}

/// Reports every 100 ms with 2 ms of transit, stamped `ahead_us(n)` ahead; returns how many were
/// not admitted in order.
fn lost(
    window: &mut ReportWindow,
    numbers: std::ops::Range<u64>,
    ahead_us: impl Fn(u64) -> i64,
) -> usize {
    let mut lost = 0;
    for n in numbers {
        let sent = Timestamp(NOON + n * 100_000);
        let report = ObjectReport {
            seq: n,
            ..report("a", sent.shifted(ahead_us(n)).micros())
        };
        match window.admit(&report, sent.shifted(2_000)) {
            Ok(InOrder(captured_at)) => {
                assert!(
                    captured_at.micros().abs_diff(sent.micros()) <= 2_000,
                    "report {n}"
                );
            }
            _ => lost += 1,
        }
    }
    lost
}

const YEAR_US: i64 = 31_536_000_000_000;

#[test]
fn clock_step_silences_briefly() {
    for step_us in [
        -3_000_000, -1_200_000, 1_200_000, 5_000_000, -5_000_000, -YEAR_US, YEAR_US,
    ] {
        let mut window = window();
        let ahead_us = |n| if n >= 50 { step_us } else { 0 };
        assert!(lost(&mut window, 0..100, ahead_us) <= 12, "{step_us} µs");
        assert!(
            lost(&mut window, 100..150, |_| 0) <= 12,
            "{step_us} µs and back"
        );
    }
}

#[test]
fn live_stream_passes_any_clock() {
    for ahead_us in [-YEAR_US, -9_000_000, 9_000_000, YEAR_US] {
        assert!(
            lost(&mut window(), 0..100, |_| ahead_us) <= 11,
            "{ahead_us} µs"
        );
    }
}

#[test]
fn emptying_queue_is_not_live() {
    let mut window = window();
    assert_eq!(lost(&mut window, 0..10, |_| 0), 0);
    for n in 10..40 {
        let received = Timestamp(NOON + 10_000_000 + n * 10_000);
        let waited = window.admit(&report("a", NOON + n * 100_000), received);
        assert_eq!(waited, Err(RejectReason::Stale), "report {n}");
    }
}

fn in_cell_time(n: u64, cell_offset_us: i64) -> ObjectReport {
    let captured_at_us = Timestamp(NOON + n * 100_000).shifted(cell_offset_us);
    ObjectReport {
        seq: n,
        captured_at_us,
        clock_error_us: Some(1_000),
        ..report("a", 0)
    }
}

#[test]
fn time_jump_costs_no_report() {
    let mut window = window();
    let mut offset_us = -YEAR_US;
    window.set_cell_offset(offset_us);
    for n in 0..300_u64 {
        if n % 100 == 50 {
            offset_us += if n == 150 { -5_000_000 } else { YEAR_US };
            window.set_cell_offset(offset_us);
        }
        let stated_us = if n % 100 < 75 {
            [-YEAR_US, 0, -5_000_000][n as usize / 100]
        } else {
            offset_us
        };
        let sent = Timestamp(NOON + n * 100_000);
        for (transit_us, expected) in [
            (7_000, Ok(InOrder(sent))),
            (9_000, Err(RejectReason::OutOfOrder)),
        ] {
            let admitted = window.admit(&in_cell_time(n, stated_us), sent.shifted(transit_us));
            assert_eq!(admitted, expected, "report {n}");
        }
    }
}

#[test]
fn late_cell_time_is_stale() {
    let mut window = window();
    for n in 0..100 {
        let admitted = window.admit(
            &in_cell_time(n, 0),
            Timestamp(NOON + n * 100_000 + 1_500_000),
        );
        assert_eq!(admitted, Err(RejectReason::Stale), "report {n}");
    }
}

#[test]
fn mistaken_cell_time_falls_back() {
    let mut window = window();
    let silent = (0..100).filter(|n| {
        let received = Timestamp(NOON + n * 100_000 + 2_000);
        window
            .admit(&in_cell_time(*n, 60_000_000), received)
            .is_err()
    });
    assert!(silent.count() <= 11);
}

#[test]
fn repeated_time_rejections_are_untimely() {
    let mut window = window();
    let mut heard = |n: u64, node: &str, ahead_us: u64| {
        let sent = NOON + n * 100_000;
        window
            .admit(&report(node, sent + ahead_us), Timestamp(sent + 2_000))
            .ok();
        window.timeliness(Timestamp(sent + 2_000))
    };
    let mut last = Timeliness::default();
    for n in 0..100 {
        heard(n, "good", 0);
        // A clock that jumps too much to be estimated.
        heard(n, "bad", n * 10_000_000);
        last = heard(n, "worse", n * 20_000_000);
    }
    assert_eq!(
        (last, last.is_usable()),
        (
            Timeliness {
                timely: 1,
                untimely: 2
            },
            true
        )
    );
    assert!(
        !Timeliness {
            timely: 1,
            untimely: 5
        }
        .is_usable()
            && Timeliness {
                timely: 0,
                untimely: 1
            }
            .is_usable()
    );
}
