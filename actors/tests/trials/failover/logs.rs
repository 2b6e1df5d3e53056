//! Reads the logs of the nodes.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use anyhow::Context;
use chrono::DateTime;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use serde::Deserialize;

use crate::failover::analysis::Accepted;
use crate::failover::doors;

/// Part of a map log's line that the trials need.
#[derive(Deserialize)]
struct Line {
    received_at_us: Timestamp,
    map: Map,
}

#[derive(Deserialize)]
struct Map {
    epoch: u64,
    aggregator: NodeName,
    round: u64,
    fused_at_us: Timestamp,
    landmarks: Vec<Landmark>,
}

#[derive(Deserialize)]
struct Landmark {
    contributors: Vec<NodeName>,
}

/// All maps of a log, without a line that a killed process left unfinished.
pub(crate) fn accepted(path: &Path) -> anyhow::Result<Vec<Accepted>> {
    maps(path, parse)
}

/// Number of maps in a log, from a time on, without a contribution of a node.
pub(crate) fn without(path: &Path, node: &NodeName, since: Timestamp) -> anyhow::Result<u64> {
    let lacks = |map: &Map| {
        map.landmarks
            .iter()
            .all(|landmark| !landmark.contributors.contains(node))
    };
    let lines = whole_lines(path)?;
    let lines = lines
        .lines()
        .map(serde_json::from_str::<Line>)
        .collect::<Result<Vec<_>, _>>()?;
    Ok(lines
        .iter()
        .filter(|line| line.received_at_us >= since && lacks(&line.map))
        .count() as u64)
}

/// All maps that a client at a node's door got.
pub(crate) fn at_door(path: &Path) -> anyhow::Result<Vec<Accepted>> {
    maps(path, |line| {
        let (time, payload) = line.split_once(' ').context("no time")?;
        let map: Map = serde_json::from_str(payload)?;
        Ok(map.received(doors::time(time).context("no time")?))
    })
}

fn maps(
    path: &Path,
    parse: impl Fn(&str) -> anyhow::Result<Accepted>,
) -> anyhow::Result<Vec<Accepted>> {
    whole_lines(path)?
        .lines()
        .map(|line| parse(line).with_context(|| format!("map log {}", path.display())))
        .collect()
}

/// The text of a log without an unfinished last line.
fn whole_lines(path: &Path) -> anyhow::Result<String> {
    let mut text = match fs::read_to_string(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(String::new()),
        text => text.with_context(|| format!("cannot read {}", path.display()))?,
    };
    text.truncate(text.rfind('\n').unwrap_or_default());
    Ok(text)
}

/// The last map of a log, if there is any yet.
pub(crate) fn last_accepted(path: &Path) -> anyhow::Result<Option<Accepted>> {
    let Some(tail) = tail(path)? else {
        return Ok(None);
    };
    let Some((whole, _)) = tail.rsplit_once('\n') else {
        return Ok(None);
    };
    let line = whole.rsplit('\n').next().unwrap_or_default();
    // The tail may begin within the only line.
    Ok(parse(line).ok())
}

/// The standby in a node's log, by its last entry about the leader.
pub(crate) fn standby(log: &Path) -> anyhow::Result<Option<NodeName>> {
    let text = fs::read_to_string(log).with_context(|| format!("cannot read {}", log.display()))?;
    let last = text.lines().rfind(|line| line.contains("position=leading"));
    let name = last
        .and_then(|line| line.split("standby=").nth(1))
        .and_then(|rest| rest.split_whitespace().next());
    Ok(name.and_then(|name| NodeName::new(name).ok()))
}

/// A trouble, as a node's log names it when it begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct LoggedTrouble {
    pub(crate) at: Timestamp,
    pub(crate) kind: String,
    /// Subject of the trouble; `None` for the node itself.
    pub(crate) about: Option<String>,
    pub(crate) cause: String,
}

/// The troubles in a node's log.
pub(crate) fn troubles(log: &Path) -> anyhow::Result<Vec<LoggedTrouble>> {
    let text = whole_lines(log)?;
    let lines = text
        .lines()
        .filter_map(|line| Some((line, line.split_once("ecod_actors::telemetry::troubles: ")?)));
    lines
        .map(|(line, (head, trouble))| {
            logged_trouble(head, trouble).with_context(|| format!("no trouble: {line}"))
        })
        .collect()
}

/// A trouble from the parts of its line before and after the name of the module.
fn logged_trouble(head: &str, trouble: &str) -> Option<LoggedTrouble> {
    let time = DateTime::parse_from_rfc3339(head.split_whitespace().next()?).ok()?;
    let (cause, fields) = trouble.split_once(" kind=\"")?;
    let (kind, rest) = fields.split_once('"')?;
    let about = rest
        .strip_prefix(" about=\"")
        .and_then(|rest| rest.split_once('"'))
        .map(|(about, _)| about.to_owned());
    Some(LoggedTrouble {
        at: Timestamp(u64::try_from(time.timestamp_micros()).ok()?),
        kind: kind.to_owned(),
        about,
        cause: cause.to_owned(),
    })
}

fn parse(line: &str) -> anyhow::Result<Accepted> {
    let Line {
        received_at_us,
        map,
    } = serde_json::from_str(line)?;
    Ok(map.received(received_at_us))
}

impl Map {
    fn received(self, at: Timestamp) -> Accepted {
        let Self {
            epoch,
            aggregator,
            round,
            fused_at_us: fused_at,
            ..
        } = self;
        Accepted {
            at,
            epoch: Epoch::new(epoch, aggregator),
            round,
            fused_at,
        }
    }
}

fn tail(path: &Path) -> anyhow::Result<Option<String>> {
    const TAIL_BYTES: u64 = 16 * 1024;
    let mut file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL_BYTES)))?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    const LINE: &str = r#"{"received_at_us":1500,"map":{"schema":1,"aggregator":"edge","epoch":3,"round":88,
        "fused_at_us":1400,"landmarks":[],"objects":[]}}"#;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        file
    }

    #[test]
    fn truncated_line_is_skipped() {
        let line = LINE.replace('\n', "");
        let log = file(&format!(
            "{line}\n{}\n{}",
            line.replace("88", "89"),
            &line[..40]
        ));
        let maps = accepted(log.path()).unwrap();
        assert_eq!(
            maps.iter().map(|map| map.round).collect::<Vec<_>>(),
            [88, 89]
        );
        assert_eq!(maps[0].epoch.to_string(), "edge@3");
        assert_eq!(last_accepted(log.path()).unwrap().as_ref(), maps.last());
    }

    #[test]
    fn maps_lacking_node_are_counted() {
        let maps = LINE.replace('\n', "");
        let euclid = NodeName::from_static("euclid");
        let seen = maps.replace(
            r#""landmarks":[]"#,
            r#""landmarks":[{"contributors":["euclid"]}]"#,
        );
        let log = file(&format!("{maps}\n{maps}\n{seen}\n"));
        let without = |since| without(log.path(), &euclid, Timestamp(since)).unwrap();
        assert_eq!((without(1500), without(1501)), (2, 0));
    }

    #[test]
    fn missing_log_has_no_maps() {
        let missing = Path::new("no/such/log");
        assert!(accepted(missing).unwrap().is_empty());
        assert_eq!(last_accepted(missing).unwrap(), None);
        assert_eq!(last_accepted(file("{\"received").path()).unwrap(), None);
    }

    #[test]
    fn troubles_are_read() {
        let lines = concat!(
            "2026-11-30T23:49:22.658009Z  WARN ecod_actors::telemetry::troubles: gone for 10 s kind=\"node_missing\" ",
            "about=\"v02\" remedy=\"start it again\"\n",
            "2026-11-30T23:49:23.000001Z  INFO ecod_actors::node: follows\n",
            "2026-11-30T23:49:24.000001Z  WARN ecod_actors::telemetry::troubles: a full disk kind=\"not_recorded\" remedy=\"-\"\n",
        );
        let found = troubles(file(lines).path()).unwrap();
        let words: Vec<_> = found
            .iter()
            .map(|it| [&*it.kind, it.about.as_deref().unwrap_or("-"), &*it.cause])
            .collect();
        assert_eq!(
            words,
            [
                ["node_missing", "v02", "gone for 10 s"],
                ["not_recorded", "-", "a full disk"]
            ]
        );
        assert_eq!(found[0].at, Timestamp(1_796_082_562_658_009));
    }

    #[test]
    fn standby_is_last_named() {
        let lines = "INFO leadership position=leading epoch=edge@1\n\
                     INFO leadership position=leading epoch=edge@1 standby=v01\n\
                     INFO leadership position=following epoch=v01@2 standby=v02\n";
        assert_eq!(
            standby(file(lines).path()).unwrap().unwrap().as_str(),
            "v01"
        );
        assert_eq!(standby(file("").path()).unwrap(), None);
    }
}
