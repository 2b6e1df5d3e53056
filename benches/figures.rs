//! The file that all benchmarks write their figures to, each into a section of its own.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

/// One benchmark's section of `target/bench.json`, or of the file that `BENCH_JSON` names.
pub(crate) struct Figures {
    section: &'static str,
    values: Map<String, Value>,
}

impl Figures {
    pub(crate) fn new(section: &'static str) -> Self {
        Self {
            section,
            values: Map::new(),
        }
    }

    /// Takes a figure, or an object of figures.
    pub(crate) fn insert(&mut self, name: impl Into<String>, value: Value) {
        self.values.insert(name.into(), value);
    }

    /// Records whether a goal was met, and prints it.
    #[allow(dead_code, reason = "not every benchmark has a goal")]
    pub(crate) fn goal(&mut self, name: &str, figure: f64, goal: f64, unit: &str) {
        let met = figure <= goal;
        println!(
            "{name}: {figure:.2}{unit}, goal {goal}{unit}: {}",
            if met { "met" } else { "MISSED" }
        );
        self.insert(
            name,
            serde_json::json!({ "figure": figure, "goal": goal, "met": met }),
        );
    }

    /// Takes how far the costs of small and large loads are from the middle between the least and the most: within
    /// half of it is the goal.
    #[allow(dead_code, reason = "not every benchmark has loads of different sizes")]
    pub(crate) fn flat(&mut self, name: &str, costs: &[f64]) {
        let least = costs.iter().copied().fold(f64::INFINITY, f64::min);
        let most = costs.iter().copied().fold(0.0, f64::max);
        self.goal(
            &format!("{name}_from_the_middle"),
            100.0 * (most - least) / (most + least),
            50.0,
            " %",
        );
    }

    /// Replaces the section in the file and keeps the others.
    ///
    /// # Panics
    /// When the file cannot be read or written, or has other content than sections.
    pub(crate) fn save(self) {
        let path = std::env::var_os("BENCH_JSON").map_or_else(default_path, PathBuf::from);
        let mut sections: Map<String, Value> = match std::fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).unwrap_or_else(|error| {
                panic!("{} has no sections of figures: {error}", path.display())
            }),
            Err(error) if error.kind() == ErrorKind::NotFound => Map::new(),
            Err(error) => panic!("cannot read {}: {error}", path.display()),
        };
        sections.insert(self.section.into(), Value::Object(self.values));
        let text = serde_json::to_string_pretty(&sections).expect("figures are plain numbers");
        std::fs::write(&path, text + "\n")
            .unwrap_or_else(|error| panic!("cannot write {}: {error}", path.display()));
    }
}

/// Cargo runs a benchmark in the directory of its package.
fn default_path() -> PathBuf {
    let workspace = [".", ".."]
        .into_iter()
        .find(|place| Path::new(place).join("Cargo.lock").exists());
    Path::new(workspace.unwrap_or(".")).join("target/bench.json")
}
