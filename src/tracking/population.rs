//! Births and departures of objects in the whole cell, estimated from the tracks.

/// Which share of new tracks become objects, and how long objects stay.
#[derive(Debug, Clone)]
pub(super) struct Population {
    /// Tracks that became objects, and those that did not.
    objects: f64,
    clutter: f64,
    /// Objects that left, and seconds for which objects stayed.
    departures: f64,
    stayed_s: f64,
}

impl Default for Population {
    fn default() -> Self {
        Self {
            objects: Self::USUAL_SHARE * Self::USUAL_BIRTHS,
            clutter: (1.0 - Self::USUAL_SHARE) * Self::USUAL_BIRTHS,
            departures: Self::USUAL_TIME_S / Self::USUAL_STAY_S,
            stayed_s: Self::USUAL_TIME_S,
        }
    }
}

impl Population {
    /// Usual share of new tracks that become objects, and the number of births as which it counts.
    const USUAL_SHARE: f64 = 0.5;
    const USUAL_BIRTHS: f64 = 4.0;

    /// Usual stay of an object in seconds, and the time in seconds as which it counts.
    const USUAL_STAY_S: f64 = 15.0;
    const USUAL_TIME_S: f64 = 60.0;

    /// Number of births, and time in seconds, beyond which earlier ones are discounted.
    const MAX_BIRTHS: f64 = 400.0;
    const MAX_TIME_S: f64 = 3000.0;

    /// Log-odds that a new track is an object.
    pub(super) fn birth_log_odds(&self) -> f64 {
        (self.objects / self.clutter).ln().clamp(-4.0, 3.0)
    }

    /// Rate at which objects leave, per second.
    pub(super) fn leaving_hz(&self) -> f64 {
        self.departures / self.stayed_s
    }

    /// Counts a track that turned out to be an object, or clutter.
    pub(super) fn settle(&mut self, is_object: bool) {
        if is_object {
            self.objects += 1.0;
        } else {
            self.clutter += 1.0;
        }
        let kept = (Self::MAX_BIRTHS / (self.objects + self.clutter)).min(1.0);
        self.objects *= kept;
        self.clutter *= kept;
    }

    /// Counts the seconds for which objects stayed, added up.
    pub(super) fn stay(&mut self, seconds: f64) {
        self.stayed_s += seconds;
        let kept = (Self::MAX_TIME_S / self.stayed_s).min(1.0);
        self.stayed_s *= kept;
        self.departures *= kept;
    }

    /// Counts an object that left.
    pub(super) fn leave(&mut self) {
        self.departures += 1.0;
    }
}
