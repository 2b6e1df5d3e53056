//! An attack, its bar, and the table of outcomes.

use std::fmt;
use std::fmt::Write as _;
use std::pin::Pin;

use crate::attacks::cell::{ROUND, Target, Victim};

/// One attack by one kind of attacker.
pub(crate) struct Row {
    /// Name, as in the table.
    pub(crate) attack: &'static str,
    pub(crate) means: Means,
    /// True for attacks on brokers: the standby's is attacked, too.
    pub(crate) on_brokers: bool,
    /// Least number of deeds, and their unit: without them the attack has not taken place.
    pub(crate) deeds: (u64, &'static str),
    pub(crate) bar: Bar,
    /// True if it runs on every change.
    pub(crate) quick: bool,
    /// The attack; it is stopped from outside unless it ends by itself.
    pub(crate) run: fn(Target) -> Attack,
}

/// A running attack.
pub(crate) type Attack = Pin<Box<dyn Future<Output = anyhow::Result<()>> + Send>>;

/// Means of an attacker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Means {
    /// Reaches the cell's ports and holds no secret.
    Stranger,
    /// Holds the cell's key, and no certificate.
    CellKey,
    /// Has the certificate of a vehicle that cannot lead.
    Vehicle,
    /// Holds the certificate of a node that may lead, and does not.
    Candidate,
    /// Owns the node that leads.
    Leader,
}

impl Means {
    fn name(self) -> &'static str {
        match self {
            Self::Stranger => "stranger",
            Self::CellKey => "cell key",
            Self::Vehicle => "cav certificate",
            Self::Candidate => "candidate's",
            Self::Leader => "leader's",
        }
    }
}

/// Least and most that a row's outcome may be.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bar {
    /// Least part of the expected maps that arrive, 0 to 1.
    pub(crate) maps: f64,
    /// Least part of the maps with the reports of all honest vehicles, 0 to 1.
    pub(crate) honest: f64,
    /// Most memory of the edge at any time, in MB.
    pub(crate) rss_mb: u64,
    /// Longest time without a map, in ms. Maps of that time are not expected.
    pub(crate) longest_gap_ms: Option<u64>,
    /// True if a different node leads at the end than at the beginning; `None` if both are allowed.
    pub(crate) is_replaced: Option<bool>,
}

/// The bar of attacks that must not affect a cell.
pub(crate) const UNHARMED: Bar = Bar {
    maps: 0.95,
    honest: 0.95,
    rss_mb: 200,
    longest_gap_ms: None,
    is_replaced: Some(false),
};

/// Measurements of a row.
#[derive(Debug, Clone)]
pub(crate) struct Outcome {
    /// Maps that an honest vehicle accepted, and the number that it expects at least: rounds end early when all have
    /// reported.
    pub(crate) maps: usize,
    pub(crate) expected: usize,
    /// Maps with the reports of all honest vehicles.
    pub(crate) honest: usize,
    /// Largest memory of a broker's process in MB.
    pub(crate) rss_mb: u64,
    /// Longest time between two maps in ms.
    pub(crate) longest_gap_ms: u64,
    /// True if the last map is of another node than the leader of the beginning.
    pub(crate) is_replaced: bool,
    /// Maps with objects that no honest vehicle has detected, or that no node of the cell made, and nodes that keep
    /// forged evidence.
    pub(crate) accepted_falsehoods: usize,
    /// Nodes that ended.
    pub(crate) ended: Vec<String>,
    /// Deeds of the attacker, and the reason for which the attack ended early.
    pub(crate) deeds: u64,
    pub(crate) fault: Option<String>,
}

impl Row {
    /// True if the attack took place and its outcome is good enough.
    pub(crate) fn is_met(&self, outcome: &Outcome) -> bool {
        self.took_place(outcome) && self.bar.is_met(outcome)
    }

    fn took_place(&self, outcome: &Outcome) -> bool {
        outcome.fault.is_none() && outcome.deeds >= self.deeds.0
    }
}

impl Bar {
    fn is_met(&self, outcome: &Outcome) -> bool {
        let part = |count: usize, of: usize| count as f64 / of.max(1) as f64;
        let missed = self
            .longest_gap_ms
            .map_or(0, |most| most / ROUND.as_millis() as u64) as usize;
        let expected = outcome.expected.saturating_sub(missed);
        part(outcome.maps, expected) >= self.maps
            && part(outcome.honest, expected.max(outcome.maps)) >= self.honest
            && outcome.rss_mb <= self.rss_mb
            && self
                .longest_gap_ms
                .is_none_or(|most| outcome.longest_gap_ms <= most)
            && self
                .is_replaced
                .is_none_or(|is_replaced| outcome.is_replaced == is_replaced)
            && outcome.accepted_falsehoods == 0
            && outcome.ended.is_empty()
    }
}

impl fmt::Display for Bar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:.0} %, {:.0} %, {} MB",
            100.0 * self.maps,
            100.0 * self.honest,
            self.rss_mb
        )?;
        self.longest_gap_ms
            .map_or(Ok(()), |most| write!(f, ", {most} ms"))
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            maps,
            expected,
            honest,
            rss_mb,
            longest_gap_ms,
            ..
        } = self;
        write!(
            f,
            "{maps} of {expected} maps, {honest} with all honest reports, {rss_mb} MB, longest gap {longest_gap_ms} ms"
        )?;
        write!(f, ", {} deeds", self.deeds)?;
        self.fault
            .iter()
            .try_for_each(|fault| write!(f, ", attack ended: {fault}"))?;
        if self.accepted_falsehoods > 0 {
            write!(
                f,
                ", {} false statements accepted",
                self.accepted_falsehoods
            )?;
        }
        if self.is_replaced {
            write!(f, ", another leader")?;
        }
        if !self.ended.is_empty() {
            write!(f, ", ended: {}", self.ended.join(", "))?;
        }
        Ok(())
    }
}

/// All outcomes, for people.
pub(crate) fn table(lines: &[(&Row, Victim, Outcome)]) -> String {
    let width = lines
        .iter()
        .map(|(row, ..)| row.attack.chars().count())
        .max()
        .unwrap_or_default();
    let mut text = format!(
        "{:width$}  {:16}  {:7}  {:22}  {:>11}  {:>6}  {:>6}  {:>6}  {:>5}  {:27}  verdict\n",
        "attack", "means", "at", "did", "maps", "honest", "RSS MB", "gap ms", "false", "bar"
    );
    for (row, victim, outcome) in lines {
        let maps = format!("{}/{}", outcome.maps, outcome.expected);
        let falsehoods = outcome.accepted_falsehoods;
        let verdict = if !row.took_place(outcome) {
            outcome.fault.as_ref().map_or_else(
                || "NOT ATTACKED: too few deeds".to_owned(),
                |fault| format!("FAILED: {fault}"),
            )
        } else if row.bar.is_met(outcome) {
            "held".to_owned()
        } else if outcome.ended.is_empty() {
            "BROKEN".to_owned()
        } else {
            format!("BROKEN, ended: {}", outcome.ended.join(", "))
        };
        let attack = row.attack;
        let means = row.means.name();
        let honest = outcome.honest;
        let rss = outcome.rss_mb;
        let gap = outcome.longest_gap_ms;
        let did = format!("{} {}", outcome.deeds, row.deeds.1);
        let at = victim.name();
        let _ = writeln!(
            text,
            "{attack:width$}  {means:16}  {at:7}  {did:22}  {maps:>11}  {honest:>6}  {rss:>6}  {gap:>6}  {falsehoods:>5}  {:27}  {verdict}",
            row.bar.to_string()
        );
    }
    text
}
