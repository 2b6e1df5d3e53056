//! Generated label sets: annotators with given habits label items with given classes.

use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Shares of the classes.
pub(crate) const BALANCES: [&[f64]; 8] = [
    &[0.5, 0.5],
    &[0.8, 0.2],
    &[0.95, 0.05],
    &[0.2, 0.8],
    &[0.34, 0.33, 0.33],
    &[0.7, 0.2, 0.1],
    &[0.4, 0.3, 0.2, 0.1],
    &[0.6, 0.2, 0.1, 0.05, 0.05],
];

/// Habits of the annotators that are not plainly honest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Habit {
    /// All are equally good.
    Equal,
    /// Accuracy differs widely.
    Spread,
    /// A quarter always states one class, mostly the commonest.
    Lazy,
    /// A quarter copies one other annotator.
    Copying,
    /// Each class is easier for some than for others.
    Partial,
    /// A third of the items is hard for all annotators.
    HardItems,
    /// All of these at once, but fewer of each.
    Mixed,
}

pub(crate) const HABITS: [Habit; 7] = [
    Habit::Equal,
    Habit::Spread,
    Habit::Lazy,
    Habit::Copying,
    Habit::Partial,
    Habit::HardItems,
    Habit::Mixed,
];

/// How many labels there are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Coverage {
    /// Labels an item; every annotator answers about as often.
    Even(usize),
    /// Labels an item; a few annotators give most of them.
    Skewed(usize),
    /// Labels an annotator, three an item.
    Few(usize),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Confidence {
    None,
    Telling,
    Meaningless,
}

/// A kind of set.
#[derive(Debug, Clone)]
pub(crate) struct Kind {
    pub(crate) balance: &'static [f64],
    pub(crate) habit: Habit,
    pub(crate) annotators: usize,
    pub(crate) coverage: Coverage,
    pub(crate) confidence: Confidence,
    /// Mean accuracy of an honest annotator.
    pub(crate) accuracy: f64,
}

pub(crate) struct Label {
    pub(crate) annotator: usize,
    pub(crate) class: usize,
    pub(crate) confidence: f64,
}

pub(crate) struct Item {
    pub(crate) truth: usize,
    pub(crate) labels: Vec<Label>,
}

/// The kind of the set of this number.
pub(crate) fn kind(number: u64) -> Kind {
    let mut rng = ChaCha8Rng::seed_from_u64(number);
    // Every balance is combined with every habit.
    let balance = BALANCES[number as usize % BALANCES.len()];
    let habit = HABITS[number as usize / BALANCES.len() % HABITS.len()];
    let coverages = [
        Coverage::Even(3),
        Coverage::Even(5),
        Coverage::Even(10),
        Coverage::Even(20),
        Coverage::Skewed(3),
        Coverage::Skewed(5),
        Coverage::Few(3),
        Coverage::Few(8),
        Coverage::Few(20),
    ];
    Kind {
        balance,
        habit,
        coverage: *coverages.choose(&mut rng).unwrap(),
        annotators: *[50, 50, 50, 25, 200].choose(&mut rng).unwrap(),
        confidence: *[
            Confidence::None,
            Confidence::None,
            Confidence::Telling,
            Confidence::Meaningless,
        ]
        .choose(&mut rng)
        .unwrap(),
        accuracy: *[0.65, 0.75, 0.85].choose(&mut rng).unwrap(),
    }
}

struct Annotator {
    /// Accuracy by class.
    accuracy: Vec<f64>,
    lazy: Option<usize>,
    copies: Option<usize>,
    activity: f64,
}

fn weighted(rng: &mut ChaCha8Rng, weights: &[f64]) -> usize {
    let mut left = rng.random_range(0.0..weights.iter().sum::<f64>());
    weights
        .iter()
        .position(|w| {
            left -= w;
            left < 0.0
        })
        .unwrap_or(weights.len() - 1)
}

impl Kind {
    /// Number of items of one set.
    fn items(&self, limit: usize) -> usize {
        match self.coverage {
            Coverage::Few(each) => (self.annotators * each / 3).max(20),
            Coverage::Even(_) | Coverage::Skewed(_) => limit,
        }
    }

    fn crowd(&self, rng: &mut ChaCha8Rng) -> Vec<Annotator> {
        let classes = self.balance.len();
        (0..self.annotators)
            .map(|number| {
                let share = number as f64 / self.annotators as f64;
                let (lazy, copying) = match self.habit {
                    Habit::Lazy => (share < 0.25, false),
                    Habit::Copying => (false, share < 0.25),
                    Habit::Mixed => (share < 0.12, (0.12..0.24).contains(&share)),
                    _ => (false, false),
                };
                let spread = match self.habit {
                    Habit::Equal => 0.0,
                    Habit::Spread | Habit::Mixed => 0.22,
                    _ => 0.1,
                };
                let own = self.accuracy + rng.random_range(-spread..=spread);
                let partial = if self.habit == Habit::Partial || self.habit == Habit::Mixed {
                    0.2
                } else {
                    0.0
                };
                let accuracy = (0..classes)
                    .map(|_| {
                        (own + rng.random_range(-partial..=partial))
                            .clamp(1.0 / classes as f64, 0.98)
                    })
                    .collect();
                let class = if rng.random_bool(0.7) {
                    0
                } else {
                    rng.random_range(0..classes)
                };
                Annotator {
                    accuracy,
                    lazy: lazy.then_some(class),
                    copies: copying.then_some(self.annotators - 1),
                    activity: match self.coverage {
                        Coverage::Skewed(_) => {
                            1.0 / (1.0 + rng.random_range(0..self.annotators) as f64)
                        }
                        _ => 1.0,
                    },
                }
            })
            .collect()
    }

    /// A set; `limit` is the number of items where labels do not limit it.
    pub(crate) fn generate(&self, seed: u64, limit: usize) -> Vec<Item> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let crowd = self.crowd(&mut rng);
        let classes = self.balance.len();
        let mut left: Vec<usize> = match self.coverage {
            Coverage::Few(each) => vec![each; crowd.len()],
            _ => vec![usize::MAX; crowd.len()],
        };
        let each = match self.coverage {
            Coverage::Even(n) | Coverage::Skewed(n) => n.min(crowd.len()),
            Coverage::Few(_) => 3,
        };
        let mut items = Vec::new();
        for _ in 0..self.items(limit) {
            let truth = weighted(&mut rng, self.balance);
            let ease = match self.habit {
                Habit::HardItems if rng.random_bool(0.33) => 0.25,
                Habit::Mixed if rng.random_bool(0.2) => 0.4,
                _ => 1.0,
            };
            // By exponential clocks: without replacement, in proportion to activity.
            let mut order: Vec<(f64, usize)> = crowd
                .iter()
                .enumerate()
                .filter(|(n, _)| left[*n] > 0)
                .map(|(n, a)| {
                    (
                        -rng.random_range(1e-12..1.0f64).ln()
                            / (a.activity * left[n].min(1000) as f64),
                        n,
                    )
                })
                .collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0));
            order.truncate(each);
            let confused = (truth + 1) % classes;
            let own = |rng: &mut ChaCha8Rng, annotator: usize| {
                let chance = 1.0 / classes as f64;
                let accuracy = chance + (crowd[annotator].accuracy[truth] - chance) * ease;
                if rng.random_bool(accuracy) {
                    truth
                } else if rng.random_bool(0.3) {
                    confused
                } else {
                    (truth + rng.random_range(1..classes)) % classes
                }
            };
            let mut said = std::collections::BTreeMap::new();
            let mut labels = Vec::new();
            for (_, annotator) in order {
                left[annotator] =
                    left[annotator].saturating_sub(usize::from(left[annotator] < usize::MAX));
                let source = crowd[annotator].copies.unwrap_or(annotator);
                let class = match crowd[annotator].lazy {
                    Some(class) => class,
                    None => *said.entry(source).or_insert_with(|| own(&mut rng, source)),
                };
                let confidence = match self.confidence {
                    Confidence::None => 1.0,
                    Confidence::Telling if class == truth => rng.random_range(0.4..1.0),
                    Confidence::Telling => rng.random_range(0.2..0.8),
                    Confidence::Meaningless => rng.random_range(0.2..1.0),
                };
                labels.push(Label {
                    annotator,
                    class,
                    confidence,
                });
            }
            labels.shuffle(&mut rng);
            if !labels.is_empty() {
                items.push(Item { truth, labels });
            }
        }
        items
    }
}
