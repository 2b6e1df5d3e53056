//! Cells of real processes whose wall clocks are wrong, step, or start in 1970, by libfaketime.
//!
//! `make clocks` runs all trials and prints a table; every run of the tests has a reduced form.

pub(crate) mod cell;
mod feeder;
mod record;

use std::time::Duration;

use cell::{Cell, Fake};
use record::{Entry, Record};

/// Nodes that see the landmark, and the client without a node.
const VEHICLES: [&str; 4] = ["euclid", "gauss", "noether", "feeder"];

/// Longest time without a vehicle's reports that its own wrong clock may cost.
const OWN_LOSS: Duration = Duration::from_secs(2);

/// Time for a process to start, to log in at the leader's broker and to send its first report.
const START_TIME: Duration = Duration::from_secs(1);

/// Longest time without a report of others: some rounds on a busy machine, but no clock.
const OTHERS_LOSS: Duration = Duration::from_millis(500);

/// Largest error of a map's date, once all three nodes that may lead are there.
const DATE_ERROR: Duration = Duration::from_millis(500);

/// One node's clock in one trial.
struct Case {
    name: &'static str,
    /// The node, or the client `feeder`.
    whose: &'static str,
    /// Its clock when it starts.
    start: Fake,
    /// Its clock later, one step after another.
    steps: &'static [Fake],
}

/// Time between two steps, and from the last one to the end.
const STEP_TIME: Duration = Duration::from_secs(8);

static CASES: [Case; 15] = [
    Case {
        name: "vehicle 5 s ahead",
        whose: "euclid",
        start: Fake::Seconds(5),
        steps: &[],
    },
    Case {
        name: "vehicle 5 s behind",
        whose: "noether",
        start: Fake::Seconds(-5),
        steps: &[],
    },
    Case {
        name: "vehicle 7 min ahead",
        whose: "euclid",
        start: Fake::Seconds(420),
        steps: &[],
    },
    Case {
        name: "vehicle a year behind",
        whose: "noether",
        start: Fake::Seconds(-31_536_000),
        steps: &[],
    },
    Case {
        name: "vehicle in 1970, then set",
        whose: "noether",
        start: Fake::Year1970,
        steps: &[Fake::Seconds(0)],
    },
    Case {
        name: "vehicle steps 3 s back",
        whose: "euclid",
        start: Fake::Seconds(0),
        steps: &[Fake::Seconds(-3)],
    },
    Case {
        name: "vehicle steps 5 s ahead and back",
        whose: "noether",
        start: Fake::Seconds(0),
        steps: &[Fake::Seconds(5), Fake::Seconds(0)],
    },
    Case {
        name: "client steps 3 s back, then ahead",
        whose: "feeder",
        start: Fake::Seconds(0),
        steps: &[Fake::Seconds(-3), Fake::Seconds(0)],
    },
    Case {
        name: "client a year behind",
        whose: "feeder",
        start: Fake::Seconds(-31_536_000),
        steps: &[],
    },
    Case {
        name: "leader 5 s ahead",
        whose: "edge",
        start: Fake::Seconds(5),
        steps: &[],
    },
    Case {
        name: "leader 5 s behind",
        whose: "edge",
        start: Fake::Seconds(-5),
        steps: &[],
    },
    Case {
        name: "leader a year behind",
        whose: "edge",
        start: Fake::Seconds(-31_536_000),
        steps: &[],
    },
    Case {
        name: "leader in 1970, then set",
        whose: "edge",
        start: Fake::Year1970,
        steps: &[Fake::Seconds(0)],
    },
    Case {
        name: "leader steps 5 s ahead, 5 s back",
        whose: "edge",
        start: Fake::Seconds(0),
        steps: &[Fake::Seconds(5), Fake::Seconds(-5)],
    },
    Case {
        name: "leader steps to 1970 and back",
        whose: "edge",
        start: Fake::Seconds(0),
        steps: &[Fake::Year1970, Fake::Seconds(0)],
    },
];

/// Trials of cells with certificates, in which the client without a node takes no part.
static CASES_WITH_CERTIFICATES: [Case; 3] = [
    Case {
        name: "certificates: vehicle 5 s behind",
        whose: "noether",
        start: Fake::Seconds(-5),
        steps: &[],
    },
    Case {
        name: "certificates: leader 5 s ahead",
        whose: "edge",
        start: Fake::Seconds(5),
        steps: &[],
    },
    Case {
        name: "certificates: leader steps 5 s back, 5 s ahead",
        whose: "edge",
        start: Fake::Seconds(0),
        steps: &[Fake::Seconds(-5), Fake::Seconds(5)],
    },
];

/// The edge starts last: with any clock, it takes over from a working leader.
fn run(case: &Case) -> Outcome {
    let has_certificates = CASES_WITH_CERTIFICATES
        .iter()
        .any(|other| other.name == case.name);
    let mut cell = if has_certificates {
        Cell::with_certificates()
    } else {
        Cell::new()
    };
    let vehicles = if has_certificates {
        &VEHICLES[..3]
    } else {
        &VEHICLES
    };
    let start = |cell: &mut Cell, name: &str| {
        cell.start(
            name,
            if name == case.whose {
                case.start
            } else {
                Fake::Off
            },
        );
    };
    let nodes = || VEHICLES.into_iter().filter(|name| *name != "feeder");
    for name in nodes().filter(|name| *name != case.whose) {
        start(&mut cell, name);
    }
    if !has_certificates {
        cell.feed(if case.whose == "feeder" {
            case.start
        } else {
            Fake::Off
        });
    }
    let others = vehicles.iter().filter(|name| **name != case.whose);
    cell.until("the others are used", |record| {
        others.clone().all(|name| record.has_lately([name]))
    });
    if let Some(late) = nodes().find(|name| *name == case.whose) {
        let begun = cell.now();
        start(&mut cell, late);
        cell.until("it is used", |record| record.has_lately([late]));
        let first = cell.record().times(begun, |map| map.has(late))[0];
        assert!(
            first.since(begun) <= START_TIME + OWN_LOSS,
            "{}: used {:?} after its start",
            case.name,
            first.since(begun)
        );
    }
    cell.until("all are used", |record| {
        vehicles.iter().all(|name| record.has_lately([name]))
    });
    let settled = cell.now();
    cell.until("all run", |record| {
        record.last_at().is_some_and(|at| at > settled)
    });
    start(&mut cell, "edge");
    cell.until("the edge leads", |record| record.source() == Some("edge"));
    let complete = cell.now() + OWN_LOSS;
    let mut until = cell.now() + STEP_TIME;
    for step in case.steps {
        cell.until("time passes", |record| {
            record.last_at().is_some_and(|at| at > until)
        });
        cell.set(case.whose, *step);
        until = until + STEP_TIME;
    }
    cell.until("time passes", |record| {
        record.last_at().is_some_and(|at| at > until)
    });
    let readiness = cell.readiness("edge");
    let is_full = |map: &Entry<'_>| vehicles.iter().all(|name| map.has(name));
    let idle = match case.whose {
        "edge" | "feeder" => cell.longest_idle("edge", settled, is_full),
        vehicle => cell.longest_idle(vehicle, settled, |map| map.has(vehicle)),
    };
    let record = cell.record();
    let losses = vehicles
        .iter()
        .map(|name| (*name, record.longest_without(name, settled)))
        .collect();
    Outcome {
        maps: record.times(settled, |_| true).len(),
        full: record.times(settled, is_full).len(),
        losses,
        readiness,
        idle,
        dated: record.farthest_date(complete),
    }
}

struct Outcome {
    maps: usize,
    /// Maps with all vehicles.
    full: usize,
    /// Longest time without each.
    losses: Vec<(&'static str, Duration)>,
    readiness: String,
    /// Longest time for which the node with that clock reported that it is ready without being useful.
    idle: Duration,
    /// Largest difference between a map's date and the true time.
    dated: Duration,
}

impl Outcome {
    fn print(&self, case: &Case) {
        let Self {
            maps,
            full,
            losses,
            readiness,
            idle,
            dated,
        } = self;
        let losses: Vec<_> = losses
            .iter()
            .map(|(name, loss)| format!("{name} {} ms", loss.as_millis()))
            .collect();
        println!(
            "{:<46} {full:>4} of {maps:>4} maps have all; longest without {}; dates wrong by {:.3} s at most; ready and useless {} ms; edge: {readiness}",
            case.name,
            losses.join(", "),
            dated.as_secs_f64(),
            idle.as_millis()
        );
    }

    fn check(&self, case: &Case) {
        for (name, loss) in &self.losses {
            let may = if *name == case.whose {
                OWN_LOSS
            } else {
                OTHERS_LOSS
            };
            assert!(*loss <= may, "{}: {loss:?} without {name}", case.name);
        }
        assert!(
            self.dated <= DATE_ERROR,
            "{}: dates wrong by {:?}",
            case.name,
            self.dated
        );
        assert!(
            self.idle <= OWN_LOSS,
            "{}: ready and useless for {:?}",
            case.name,
            self.idle
        );
    }
}

fn passes(case: &Case) {
    let outcome = run(case);
    outcome.print(case);
    outcome.check(case);
}

#[test]
fn nodes_with_wrong_clocks_participate() {
    for case in CASES.iter().filter(|case| {
        [
            "vehicle in 1970, then set",
            "leader steps 5 s ahead, 5 s back",
        ]
        .contains(&case.name)
    }) {
        passes(case);
    }
}

/// The node and the others reject each other's certificates. The node reports this and waits, and becomes a member as
/// soon as its clock is set.
#[test]
fn certified_node_waits_for_clock() {
    for late in ["noether", "edge"] {
        let mut cell = Cell::with_certificates();
        for name in ["euclid", "gauss"] {
            cell.start(name, Fake::Off);
        }
        cell.until("both are used", |record| {
            record.has_lately(["euclid", "gauss"])
        });
        let started = cell.now();
        cell.start(late, Fake::Year1970);
        cell.until_unready(late, "this machine's clock reads 1970-");
        let waiting = cell.now() + STEP_TIME;
        cell.until("time passes", |record| {
            record.last_at().is_some_and(|at| at > waiting)
        });
        assert_eq!(
            cell.longest_idle(late, started, |_| false),
            Duration::ZERO,
            "{late} was ready in 1970"
        );
        assert!(!cell.record().has_lately([late]) && cell.record().source() != Some(late));
        cell.set(late, Fake::Seconds(0));
        let set_at = cell.now();
        let takes_part = |record: &Record| match late {
            // As the better candidate it leads after its trial.
            "edge" => record.source() == Some("edge"),
            vehicle => record.has_lately([vehicle]),
        };
        cell.until("the node is a member", takes_part);
        let took = cell.first_ready(late, set_at).since(set_at);
        println!("{late}, with a certificate, was ready {took:?} after its clock was set");
        let end = cell.now() + OWN_LOSS;
        cell.until("time passes", |record| {
            record.last_at().is_some_and(|at| at > end)
        });
        let losses = ["euclid", "gauss"].map(|name| cell.record().longest_without(name, started));
        println!("others lost {losses:?}, {}", cell.readiness(late));
        assert!(
            losses.iter().all(|loss| *loss <= OTHERS_LOSS),
            "{late}: {losses:?}"
        );
        assert!(took <= OWN_LOSS, "{late}: {took:?}");
        assert!(cell.readiness(late).contains("\"ready\":true"));
    }
}

#[test]
#[ignore = "takes minutes: make clocks"]
fn all() {
    let only = std::env::var("TRIAL").unwrap_or_default();
    let tried = |case: &'static Case| {
        let outcome = run(case);
        outcome.print(case);
        (case, outcome)
    };
    let cases = CASES
        .iter()
        .chain(&CASES_WITH_CERTIFICATES)
        .filter(|case| case.name.contains(&only));
    let outcomes: Vec<_> = cases.map(tried).collect();
    outcomes
        .iter()
        .for_each(|(case, outcome)| outcome.check(case));
}
