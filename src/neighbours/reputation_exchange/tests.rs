use super::*;
use crate::reputation::Counts;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn at(s: u64) -> Timestamp {
    Timestamp(1_700_000_000_000_000 + s * 1_000_000)
}

fn counts(correct: u64, incorrect: u64) -> CellCounts {
    CellCounts {
        all: Counts { correct, incorrect },
        ..CellCounts::default()
    }
}

/// A broker that keeps the last message of each topic.
#[derive(Default)]
struct Retained(BTreeMap<(NodeName, NodeName), CellReputation>);

impl Retained {
    /// Carries out a leader's next steps; returns the filters that it subscribes to and
    /// unsubscribes from, and its messages.
    fn serve(
        &mut self,
        exchange: &mut ReputationExchange,
        now: Timestamp,
    ) -> (Vec<String>, Vec<String>, usize) {
        let (mut begun, mut ended, mut sent) = (Vec::new(), Vec::new(), 0);
        for step in exchange.next(now, 8) {
            match step {
                ExchangeStep::Subscribe(filters) => {
                    for message in self.0.values() {
                        let topic = ReputationTopic {
                            vehicle: message.vehicle.clone(),
                            cell: message.cell.clone(),
                        };
                        let all = ReputationTopic::filter_of_vehicle(&message.vehicle);
                        if filters.contains(&topic.path()) || filters.contains(&all) {
                            exchange.hear(message, now);
                        }
                    }
                    begun.extend(filters);
                }
                ExchangeStep::Unsubscribe(filters) => ended.extend(filters),
                ExchangeStep::Publish(message) => {
                    sent += 1;
                    exchange.hear(&message, now);
                    self.0
                        .insert((message.vehicle.clone(), message.cell.clone()), message);
                }
            }
        }
        (begun, ended, sent)
    }

    fn of(&self, vehicle: &str, cell: &str) -> Option<(u64, u64)> {
        let message = self.0.get(&(name(vehicle), name(cell)))?;
        Some((message.correct, message.incorrect))
    }
}

/// The cells with news; panics if there is no news due.
fn cells_in_news(exchange: &mut ReputationExchange, now: Timestamp) -> Vec<String> {
    let news = exchange.take_news(now).expect("news are due");
    news.cells().into_iter().map(NodeName::to_string).collect()
}

#[test]
fn a_cells_first_word_about_a_vehicle_is_told_at_once_and_further_counts_once_a_second() {
    let mut exchange = ReputationExchange::new(name("a"));
    let present = [name("euclid"), name("gauss")].into();
    let ms = |ms: u64| at(0) + Duration::from_millis(ms);
    exchange.set_present(&present);
    assert!(
        cells_in_news(&mut exchange, ms(0)).is_empty(),
        "an earlier leader may have told more"
    );
    let hear = |exchange: &mut ReputationExchange, vehicle: &str, wrong: u64, now| {
        exchange.hear(&counts(0, wrong).message(name("b"), name(vehicle)), now)
    };
    let mut told = Vec::new();
    for now in (10..3000).step_by(10) {
        assert!(hear(&mut exchange, "euclid", now, ms(now)));
        if now == 1500 {
            assert!(hear(&mut exchange, "gauss", 1, ms(now)));
        }
        told.extend(exchange.take_news(ms(now)).map(|_| now));
    }
    assert_eq!(told, [30, 1040, 1520, 2530]);
    exchange.set_present(&present);
    assert_eq!(
        cells_in_news(&mut exchange, ms(3000)),
        ["b"],
        "an aggregator that began anew"
    );
    exchange.set_present(&[name("euclid"), name("gauss"), name("noether")].into());
    assert_eq!(
        exchange.take_news(ms(3001)),
        None,
        "of whom nobody has said anything"
    );
    exchange.count(&name("gauss"), counts(5, 0), ms(4000));
    assert_eq!(
        exchange.take_news(ms(5000)),
        None,
        "nor contradicted anybody"
    );
    assert!(hear(&mut exchange, "gauss", 50, ms(5000)) && exchange.take_news(ms(6000)).is_some());
    exchange.count(&name("gauss"), counts(50, 0), ms(6000));
    assert_eq!(
        cells_in_news(&mut exchange, ms(7000)),
        ["b"],
        "which is worth less now"
    );
}

#[test]
fn a_leader_asks_about_who_is_present_and_about_nobody_else() {
    let mut region = Retained::default();
    let mut exchange = ReputationExchange::new(name("b"));
    for (vehicle, cell) in [("euclid", "a"), ("gauss", "a"), ("euclid", "c")] {
        let message = counts(3, 40).message(name(cell), name(vehicle));
        region.0.insert((name(vehicle), name(cell)), message);
    }
    exchange.connect();
    exchange.set_present(&[name("euclid")].into());
    assert_eq!(
        region.serve(&mut exchange, at(0)),
        (vec!["ecod/v1/rep/euclid/+".into()], Vec::new(), 0)
    );
    assert_eq!(cells_in_news(&mut exchange, at(1)), ["a", "c"]);
    assert_eq!(
        region.serve(&mut exchange, at(1)),
        Default::default(),
        "once"
    );

    exchange.set_present(&[name("gauss")].into());
    assert!(
        cells_in_news(&mut exchange, at(2)).is_empty(),
        "what is said of those who left is forgotten"
    );
    let (begun, ended) = (
        vec!["ecod/v1/rep/gauss/+".into()],
        vec!["ecod/v1/rep/euclid/+".into()],
    );
    assert_eq!(region.serve(&mut exchange, at(2)), (begun, ended, 0));
    assert!(
        !exchange.hear(&counts(0, 1).message(name("a"), name("euclid")), at(2)),
        "and is no news"
    );
    exchange.connect();
    assert_eq!(
        region.serve(&mut exchange, at(3)).0,
        ["ecod/v1/rep/gauss/+"],
        "a new connection knows nothing"
    );
}

#[test]
fn counts_are_sent_when_they_say_something_new_and_when_their_vehicle_leaves() {
    let mut region = Retained::default();
    let mut exchange = ReputationExchange::new(name("a"));
    let euclid = name("euclid");
    exchange.connect();
    exchange.set_present(&[euclid.clone()].into());
    let mut sent = 0;
    for second in 0..600 {
        exchange.count(&euclid, counts(second * 9, second), at(second));
        sent += region.serve(&mut exchange, at(second)).2;
    }
    assert!((5..=20).contains(&sent), "{sent} messages in ten minutes");
    assert!(region.of("euclid", "a").unwrap().0 > 3000);
    exchange.set_present(&BTreeSet::new());
    (600..640).for_each(|second| _ = region.serve(&mut exchange, at(second)));
    assert_eq!(region.of("euclid", "a"), Some((5391, 599)), "the last word");
    assert!(exchange.vehicles.is_empty());
}

#[test]
fn whoever_turns_is_told_of_soon() {
    let mut region = Retained::default();
    let mut exchange = ReputationExchange::new(name("a"));
    let euclid = name("euclid");
    exchange.set_present(&[euclid.clone()].into());
    let remembered = |wrong: u64| CellCounts {
        all: Counts {
            correct: 10_000,
            incorrect: wrong,
        },
        old: Counts {
            correct: 9_500 + wrong,
            incorrect: 0,
        },
        ..CellCounts::default()
    };
    exchange.count(&euclid, remembered(0), at(0));
    (0..30).for_each(|second| _ = region.serve(&mut exchange, at(second)));
    exchange.count(&euclid, remembered(40), at(30));
    region.serve(&mut exchange, at(30));
    assert_eq!(region.of("euclid", "a"), Some((10_000, 40)));
}

#[test]
fn without_a_connection_the_latest_counts_wait_and_those_with_most_votes_are_kept() {
    let mut exchange = ReputationExchange::new(name("a"));
    for votes in 1..=10 {
        for number in 0..MAX_WAITING as u64 + 100 {
            exchange.count(
                &name(&format!("v{number}")),
                counts(votes * number, 0),
                at(0),
            );
        }
    }
    assert_eq!(
        (exchange.vehicles.len(), exchange.dropped() > 0),
        (MAX_WAITING, true)
    );
    let mut region = Retained::default();
    exchange.connect();
    (0..600).for_each(|tick| _ = region.serve(&mut exchange, at(tick)));
    assert_eq!(
        (region.0.len(), exchange.vehicles.len()),
        (MAX_WAITING, 0),
        "each once, and nothing waits any more"
    );
    assert_eq!(region.of("v1123", "a"), Some((11_230, 0)));
}

/// A message that does not come back is sent again, and a broker that has lost all messages gets
/// them again.
#[test]
fn a_message_that_is_lost_is_repeated() {
    let mut exchange = ReputationExchange::new(name("a"));
    let euclid = name("euclid");
    exchange.count(&euclid, counts(30, 2), at(0));
    let mut publishes = |second| {
        let steps = exchange.next(at(second), 8);
        steps
            .iter()
            .filter(|step| matches!(step, ExchangeStep::Publish(_)))
            .count()
    };
    let sent: Vec<_> = (0..30).filter(|second| publishes(*second) > 0).collect();
    assert_eq!(sent, [2, 12, 22]);
    let mut region = Retained::default();
    exchange.set_present(&[euclid].into());
    (30..40).for_each(|second| _ = region.serve(&mut exchange, at(second)));
    assert_eq!(region.of("euclid", "a"), Some((30, 2)));
    let mut empty = Retained::default();
    exchange.connect();
    (40..50).for_each(|second| _ = empty.serve(&mut exchange, at(second)));
    assert_eq!(empty.of("euclid", "a"), Some((30, 2)));
}

#[test]
fn a_leader_that_knows_less_than_its_region_lowers_nothing_but_by_a_reset() {
    let mut region = Retained::default();
    region.0.insert(
        (name("euclid"), name("a")),
        counts(400, 7).message(name("a"), name("euclid")),
    );
    let mut exchange = ReputationExchange::new(name("a"));
    exchange.set_present(&[name("euclid")].into());
    let mut count = |exchange: &mut ReputationExchange, counts, from: u64| {
        exchange.count(&name("euclid"), counts, at(from));
        (from..from + 20).for_each(|second| _ = region.serve(exchange, at(second)));
        region.of("euclid", "a")
    };
    assert_eq!(count(&mut exchange, counts(3, 200), 0), Some((400, 200)));
    let reset = |correct, incorrect, second| CellCounts {
        reset_at: at(second),
        ..counts(correct, incorrect)
    };
    assert_eq!(
        count(&mut exchange, reset(1, 0, 25), 30),
        Some((1, 0)),
        "after a reset they begin anew"
    );
    assert_eq!(count(&mut exchange, reset(2, 0, 25), 60), Some((2, 0)));
    let mut late = ReputationExchange::new(name("a"));
    late.set_present(&[name("euclid")].into());
    assert_eq!(
        count(&mut late, counts(500, 9), 90),
        Some((2, 0)),
        "a node that has not heard of it undoes nothing"
    );
    let later = CellCounts {
        old: Counts {
            correct: 400,
            incorrect: 0,
        },
        ..counts(600, 10)
    };
    assert_eq!(
        count(&mut late, later, 120),
        Some((102, 1)),
        "and counts on"
    );
    late.connect();
    let latest = CellCounts {
        old: Counts {
            correct: 510,
            incorrect: 0,
        },
        ..counts(700, 10)
    };
    assert_eq!(
        count(&mut late, latest, 150),
        Some((202, 1)),
        "on each connection"
    );
    assert_eq!(
        count(&mut late, reset(500, 20, 25), 180),
        Some((500, 20)),
        "until it has heard of it"
    );
    let told = region.0.values().next().unwrap();
    assert_eq!(
        (told.reset_at_us, told.old_correct),
        (Some(at(25)), 10),
        "votes from before the reset are no older ones"
    );
}

#[test]
fn counts_of_one_that_has_left_are_told_again_if_the_broker_has_not_kept_them() {
    let mut region = Retained::default();
    let mut exchange = ReputationExchange::new(name("a"));
    exchange.count(&name("euclid"), counts(30, 2), at(0));
    (0..5).for_each(|second| _ = region.serve(&mut exchange, at(second)));
    assert_eq!(region.of("euclid", "a"), Some((30, 2)));
    // It passed the message on, and was killed before it had written it down.
    region.0.clear();
    (5..30).for_each(|second| _ = region.serve(&mut exchange, at(second)));
    assert_eq!(region.of("euclid", "a"), Some((30, 2)));
    assert!(exchange.vehicles.is_empty(), "and that is all");
}

#[test]
fn a_region_that_answers_late_loses_nothing() {
    let mut exchange = ReputationExchange::new(name("a"));
    let euclid = name("euclid");
    exchange.set_present(&[euclid.clone()].into());
    exchange.count(&euclid, counts(3, 200), at(0));
    let sent = |exchange: &mut ReputationExchange, second| {
        exchange
            .next(at(second), 8)
            .into_iter()
            .find_map(|step| match step {
                ExchangeStep::Publish(message) => Some(message),
                _ => None,
            })
    };
    assert_eq!(sent(&mut exchange, 0), None);
    let message = sent(&mut exchange, 3).unwrap();
    // The retained message arrives first, then the message that replaced it.
    exchange.hear(&counts(400, 7).message(name("a"), euclid.clone()), at(4));
    exchange.hear(&message, at(4));
    assert_eq!(
        sent(&mut exchange, 13),
        Some(counts(400, 200).message(name("a"), euclid))
    );
}

#[test]
fn a_leader_that_leaves_tells_all_that_it_may_and_never_what_others_said() {
    let mut exchange = ReputationExchange::new(name("a"));
    exchange.count(&name("euclid"), counts(30, 2), at(0));
    assert!(
        exchange.farewell(at(0)).is_empty(),
        "it does not know yet what the region has"
    );
    exchange.set_present(&[name("euclid"), name("gauss")].into());
    exchange.next(at(0), 8);
    assert!(exchange.hear(&counts(0, 50).message(name("b"), name("gauss")), at(0)));
    assert!(exchange.farewell(at(1)).is_empty());
    let told = exchange.farewell(at(2));
    assert_eq!(told, [counts(30, 2).message(name("a"), name("euclid"))]);
}
