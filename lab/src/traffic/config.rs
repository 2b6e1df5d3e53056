//! Parameters of the traffic.

use std::f64::consts::TAU;

use ecod::config::{ConfigError, check_range};
use serde::{Deserialize, Serialize};

/// Parameters of the traffic and of its observers. The default is a quarter of a town with eight
/// observers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrafficConfig {
    /// Number of reporting vehicles among the moving ones. Default 8.
    pub observers: usize,
    /// Vehicles that move, observers among them. Default 60.
    pub vehicles: usize,
    /// Vehicles that are parked. Default 40.
    pub parked: usize,
    /// Number of parked vehicles that also report, in addition to the `observers`. Default 0.
    pub standing: usize,
    /// People on the pavements. Default 30; with 0 and no bicycles there is one class only.
    pub people: usize,
    /// Bicycles beside the lanes. Default 12.
    pub bicycles: usize,
    /// Roads each way; they cross in a square grid. Default 4.
    pub roads: usize,
    /// Metres between roads. Default 80.
    pub block_m: f64,
    /// Duration in seconds. Default 30.
    pub duration_s: f64,
    /// Seconds of traffic before the first report, so that it has sorted itself. Default 20.
    pub warm_up_s: f64,
    /// The observers drive one behind the other and on the same route. Default false.
    pub convoy: bool,
    /// The observers are cameras on posts, four about a crossing, whose pose errors stay. Default
    /// false.
    pub fixed: bool,
    /// All observers capture at the same moments and reports arrive at once. Default false: each
    /// observer has its own phase, and reports are delayed.
    pub synchronous: bool,
    /// Seconds for which an object that observers have lost from view still belongs to the truth.
    /// Default 1.
    pub memory_s: f64,
    /// Sensors of the observers.
    pub sensor: SensorConfig,
    /// Optional parts of reports, in addition to labels, confidences and positions.
    pub said: ReportedFields,
}

/// Sensor of an observer and its errors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorConfig {
    /// Reports a second. Default 10.
    pub rate_hz: f64,
    /// Metres up to which anything is seen. Default 60.
    pub range_m: f64,
    /// Opening angle in radians, all around by default.
    pub angle_rad: f64,
    /// Standard deviation of positions in metres near by. Default 0.12.
    pub noise_m: f64,
    /// Addition to it for every metre of range. Default 0.005.
    pub noise_per_m: f64,
    /// Standard deviation in metres of an observer's error about one object, which lasts for about
    /// a second. Default 0.15.
    pub bias_m: f64,
    /// False alarms of one frame, on average per report. Default 0.8.
    pub clutter: f64,
    /// Lasting false alarms, on average begun per second by each observer. Default 0.25.
    pub ghosts_per_s: f64,
    /// Places per block that look like an object to all passing vehicles. Default 0.7.
    pub lures: f64,
    /// Standard deviation of an observer's own position in metres; changes within half a minute.
    /// Default 0.35.
    pub pose_m: f64,
    /// Standard deviation of its heading in radians. Default 0.01.
    pub pose_rad: f64,
    /// Time in seconds by which every second observer stamps its captures late. Default 0.
    pub stamped_late_s: f64,
    /// Mean delay of a report in seconds beyond 30 ms. Default 0.025.
    pub latency_s: f64,
    /// Share of reports that are lost; as many come 0.2 to 0.5 s late. Default 0.01.
    pub lost: f64,
}

/// Optional parts of reports, in addition to labels, confidences and positions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReportedFields {
    /// Their poses. Default true.
    pub poses: bool,
    /// Covariances of positions, without biases and pose errors, as detectors do. Default true.
    pub covariances: bool,
    /// Area that their sensors cover; needs poses. Default true.
    pub views: bool,
    /// Velocities, with such a standard deviation in metres per second in each direction; absent by
    /// default.
    pub velocities_mps: Option<f64>,
    /// Headings, with such a standard deviation in radians; absent by default.
    pub headings_rad: Option<f64>,
    /// Lengths and widths, with such a standard deviation in metres; absent by default.
    pub sizes_m: Option<f64>,
}

impl Default for TrafficConfig {
    fn default() -> Self {
        Self {
            observers: 8,
            vehicles: 60,
            parked: 40,
            standing: 0,
            people: 30,
            bicycles: 12,
            roads: 4,
            block_m: 80.0,
            duration_s: 30.0,
            warm_up_s: 20.0,
            convoy: false,
            fixed: false,
            synchronous: false,
            memory_s: 1.0,
            sensor: SensorConfig::default(),
            said: ReportedFields::default(),
        }
    }
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self {
            rate_hz: 10.0,
            range_m: 60.0,
            angle_rad: TAU,
            noise_m: 0.12,
            noise_per_m: 0.005,
            bias_m: 0.15,
            clutter: 0.8,
            ghosts_per_s: 0.25,
            lures: 0.7,
            pose_m: 0.35,
            pose_rad: 0.01,
            stamped_late_s: 0.0,
            latency_s: 0.025,
            lost: 0.01,
        }
    }
}

impl Default for ReportedFields {
    fn default() -> Self {
        Self {
            poses: true,
            covariances: true,
            views: true,
            velocities_mps: None,
            headings_rad: None,
            sizes_m: None,
        }
    }
}

impl TrafficConfig {
    /// Like a recording of two vehicles with scanners on one route: cars only, captured together,
    /// no poses, no covariances, some tens of metres of range.
    pub fn two_vehicle_recording() -> Self {
        Self {
            observers: 2,
            people: 0,
            bicycles: 0,
            convoy: true,
            synchronous: true,
            memory_s: 0.3,
            sensor: SensorConfig {
                range_m: 50.0,
                clutter: 0.5,
                ghosts_per_s: 0.15,
                lures: 0.4,
                ..SensorConfig::default()
            },
            said: ReportedFields {
                poses: false,
                covariances: false,
                views: false,
                ..ReportedFields::default()
            },
            ..Self::default()
        }
    }

    /// Long roads around one block: observers pass parked observers, one after the other, and
    /// continue to report.
    pub fn much_passed() -> Self {
        Self {
            observers: 24,
            vehicles: 24,
            parked: 24,
            standing: 12,
            people: 12,
            bicycles: 6,
            roads: 2,
            block_m: 200.0,
            duration_s: 120.0,
            ..Self::default()
        }
    }

    /// Checks all values.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("roads", self.roads as f64, 2.0, 32.0)?;
        check_range("block_m", self.block_m, 50.0, 1000.0)?;
        // A vehicle and the gap before it take some 15 m of each of the two lanes.
        let lanes_m = 4.0 * (self.roads * (self.roads - 1)) as f64 * self.block_m;
        check_range("vehicles", self.vehicles as f64, 1.0, lanes_m / 15.0)?;
        let posts = 4 * self.roads * self.roads;
        let max_observers = if self.fixed { posts } else { self.vehicles };
        check_range(
            "observers",
            self.observers as f64,
            1.0,
            max_observers as f64,
        )?;
        check_range("parked", self.parked as f64, 0.0, lanes_m / 15.0)?;
        let max_standing = if self.fixed { 0 } else { self.parked };
        check_range("standing", self.standing as f64, 0.0, max_standing as f64)?;
        check_range("people", self.people as f64, 0.0, 1e4)?;
        check_range("bicycles", self.bicycles as f64, 0.0, 1e4)?;
        check_range("duration_s", self.duration_s, 0.1, 3600.0)?;
        check_range("warm_up_s", self.warm_up_s, 0.0, 3600.0)?;
        check_range("memory_s", self.memory_s, 0.0, 3600.0)?;
        let ReportedFields {
            velocities_mps,
            headings_rad,
            sizes_m,
            ..
        } = self.said;
        for (key, value) in [
            ("velocities_mps", velocities_mps),
            ("headings_rad", headings_rad),
            ("sizes_m", sizes_m),
        ] {
            check_range(key, value.unwrap_or_default(), 0.0, 100.0)
                .map_err(|error| error.within("said"))?;
        }
        self.sensor
            .validate()
            .map_err(|error| error.within("sensor"))
    }
}

impl SensorConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check_range("rate_hz", self.rate_hz, 0.1, 50.0)?;
        check_range("range_m", self.range_m, 1.0, 1000.0)?;
        check_range("angle_rad", self.angle_rad, 0.01, TAU)?;
        check_range("lost", self.lost, 0.0, 0.5)?;
        for (key, value) in [
            ("noise_m", self.noise_m),
            ("noise_per_m", self.noise_per_m),
            ("bias_m", self.bias_m),
            ("clutter", self.clutter),
            ("ghosts_per_s", self.ghosts_per_s),
            ("lures", self.lures),
            ("pose_m", self.pose_m),
            ("pose_rad", self.pose_rad),
            ("stamped_late_s", self.stamped_late_s),
            ("latency_s", self.latency_s),
        ] {
            check_range(key, value, 0.0, 100.0)?;
        }
        Ok(())
    }
}
