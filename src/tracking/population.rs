//! Births and departures of objects, estimated from the tracks.

use super::fading_mean::FadingMean;

/// Share of the tracks begun by one vehicle that become objects.
#[derive(Debug, Clone, Default)]
pub(super) struct Births(FadingMean);

impl Births {
    /// Usual share of new tracks that become objects.
    const USUAL_SHARE: f64 = 0.5;

    /// Number of births as which the usual share counts.
    const USUAL: f64 = 4.0;

    /// Maximum log-odds: a good record does not make the first detection of an object sure.
    const MAX_NATS: f64 = 3.0;

    /// Log-odds that a new track is an object.
    pub(super) fn log_odds(&self) -> f64 {
        let share = self.0.mean_with(Self::USUAL_SHARE, Self::USUAL);
        (share / (1.0 - share)).ln().min(Self::MAX_NATS)
    }

    /// Counts a new track that became an object or turned out to be clutter.
    pub(super) fn settle(&mut self, is_object: bool) {
        self.0.count(is_object, 1.0);
    }
}

/// Rates at which objects leave, per second.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeavingRates {
    detected_hz: f64,
    undetected_hz: f64,
}

impl LeavingRates {
    /// Objects leave at `leaving_hz`; undetected ones also leave after a mean time of `life_s` seconds.
    pub(super) fn new(leaving_hz: f64, life_s: f64) -> Self {
        Self {
            detected_hz: leaving_hz,
            undetected_hz: leaving_hz + 1.0 / life_s,
        }
    }

    /// The rate of an object that a vehicle detects, or that all vehicles miss.
    pub(super) fn of(&self, is_detected: bool) -> f64 {
        if is_detected {
            self.detected_hz
        } else {
            self.undetected_hz
        }
    }
}

/// The time for which the objects stay whose tracks one vehicle began.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Population {
    /// Number of objects that left and whose tracks are gone.
    departures: f64,
    /// Expected number of objects that have left, and whose tracks still exist.
    absent: f64,
    /// Seconds for which objects stayed.
    stayed_s: f64,
}

impl Population {
    /// Usual stay of an object in seconds.
    const USUAL_STAY_S: f64 = 15.0;

    /// Time in seconds as which the usual stay counts.
    const USUAL_TIME_S: f64 = 60.0;

    /// Time in seconds beyond which earlier stays are discounted.
    const MAX_TIME_S: f64 = 3000.0;

    /// Rate at which the objects of all vehicles leave, per second.
    ///
    /// The vehicle whose objects leave at the highest rate does not count, unless it is the only one:
    /// a vehicle may invent objects that come and go, and existences of all vehicles' objects fade at
    /// this rate.
    pub(super) fn leaving_hz<'a>(of_vehicles: impl Iterator<Item = &'a Self>) -> f64 {
        let mut sum = Self::usual();
        let mut vehicles = 0;
        let mut highest: Option<Self> = None;
        for population in of_vehicles.filter(|population| population.stayed_s > 0.0) {
            vehicles += 1;
            sum.departures += population.departures;
            sum.absent += population.absent;
            sum.stayed_s += population.stayed_s;
            let is_highest = highest.is_none_or(|highest| population.rate() > highest.rate());
            if is_highest {
                highest = Some(*population);
            }
        }
        if let Some(highest) = highest.filter(|_| vehicles > 1) {
            sum.departures -= highest.departures;
            sum.absent -= highest.absent;
            sum.stayed_s -= highest.stayed_s;
        }
        sum.rate()
    }

    fn usual() -> Self {
        Self {
            departures: Self::USUAL_TIME_S / Self::USUAL_STAY_S,
            absent: 0.0,
            stayed_s: Self::USUAL_TIME_S,
        }
    }

    fn rate(&self) -> f64 {
        (self.departures + self.absent) / self.stayed_s
    }

    /// Starts to count the objects of a round.
    pub(super) fn begin_round(&mut self) {
        self.absent = 0.0;
    }

    /// Counts an object with a track that is present with a probability, for the seconds of a round.
    pub(super) fn count(&mut self, present: f64, seconds: f64) {
        self.absent += 1.0 - present;
        self.stayed_s += present * seconds;
        let kept = (Self::MAX_TIME_S / self.stayed_s).min(1.0);
        self.stayed_s *= kept;
        self.departures *= kept;
    }

    /// Counts an object that left and whose track is gone.
    pub(super) fn leave(&mut self) {
        self.departures += 1.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absent_objects_count_as_departures() {
        let mut population = Population::default();
        let rate = |population: &Population| Population::leaving_hz(std::iter::once(population));
        for _ in 0..100 {
            population.begin_round();
            for _ in 0..10 {
                population.count(1.0, 0.1);
            }
        }
        let staying = rate(&population);
        population.begin_round();
        for present in [1.0, 1.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1] {
            population.count(present, 0.1);
        }
        assert!(rate(&population) > 2.0 * staying, "{staying}");
        population.begin_round();
        for _ in 0..10 {
            population.count(1.0, 0.1);
        }
        assert!(rate(&population) <= staying, "all objects are back");
    }
}
