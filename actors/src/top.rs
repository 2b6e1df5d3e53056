//! Terminal view of a cell, as an observer sees it: leader, locations and objects, nodes, losses.

use std::collections::VecDeque;
use std::time::Duration;

use ecod::diagnostics::in_words;
use ecod::leadership::Leadership;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{Reputations, Trouble, Verdict, Verdicts};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Row, Table, Wrap};

use crate::messages::newest::{Received, ReceivedMap};
use crate::node::NodeHandle;
use crate::node::config::NodeConfig;
use crate::observe::readiness::{newest_round, patience};
use crate::telemetry::counters::CounterSnapshot;
use crate::transport::gossip::Member;

/// Maximum number of troubles shown.
const MAX_TROUBLES: usize = 4;

/// Maximum number of leaderships shown.
const HISTORY: usize = 5;

/// State of a cell at one moment.
#[derive(Debug)]
pub struct CellView {
    /// Name of the observed cell.
    pub cell: NodeName,
    /// Age from which the newest round counts as stale, if rounds are periodic.
    pub patience: Option<Duration>,
    /// Time of this state by the observer's clock.
    pub now: Timestamp,
    /// Leadership of the cell as the observer sees it.
    pub leadership: Leadership,
    /// Leaderships by their first round, and the time of that round; newest last.
    pub history: VecDeque<(Epoch, Timestamp)>,
    /// All living nodes except the observer.
    pub members: Vec<Member>,
    /// Newest accepted map; `None` before the first.
    pub map: Option<ReceivedMap>,
    /// Newest accepted verdicts; `None` before the first.
    pub verdicts: Option<Received<Verdicts>>,
    /// Newest accepted reputations; `None` before the first.
    pub reputations: Option<Received<Reputations>>,
    /// Current troubles of the cell, with the node that reports each.
    pub troubles: Vec<(Option<NodeName>, Trouble)>,
    /// How vehicles begin to report, for a cell without reports.
    pub guide: String,
    /// Counters of the observer at this time.
    pub counters: CounterSnapshot,
    /// Number of lines above the first visible one.
    pub scroll: usize,
}

impl CellView {
    /// State of the node's cell; history and scroll position continue from `before`.
    pub fn of(
        node: &NodeHandle,
        config: &NodeConfig,
        before: Option<Self>,
        now: Timestamp,
    ) -> Self {
        let (history, scroll) = before
            .map(|before| (before.history, before.scroll))
            .unwrap_or_default();
        let mut view = Self {
            cell: config.cell.clone(),
            patience: patience(&config.fusion),
            now,
            leadership: node.leadership().borrow().clone(),
            history,
            members: node.other_nodes(),
            map: node.newest_map().borrow().clone(),
            verdicts: node.newest_verdicts().borrow().clone(),
            reputations: node.newest_reputations().borrow().clone(),
            troubles: node.troubles(),
            guide: config.reporting(None),
            counters: node.counters().snapshot(),
            scroll,
        };
        view.update_history();
        view
    }

    /// Adds the leadership of the newest round to the history.
    fn update_history(&mut self) {
        let Some((epoch, received_at)) = self.newest_round() else {
            return;
        };
        if self
            .history
            .back()
            .is_none_or(|(newest, _)| *newest != epoch)
        {
            self.history.push_back((epoch, received_at));
        }
        while self.history.len() > HISTORY {
            self.history.pop_front();
        }
    }

    fn newest_round(&self) -> Option<(Epoch, Timestamp)> {
        newest_round(self.map.as_ref(), self.verdicts.as_ref())
    }
}

/// Draws the cell, and limits the scroll position to the last line.
pub fn draw(frame: &mut Frame<'_>, view: &mut CellView) {
    // Two lines for each trouble, and the borders.
    let height = if view.troubles.is_empty() {
        0
    } else {
        2 + 2 * view.troubles.len().min(MAX_TROUBLES) as u16
    };
    let [head, wrong, places, below, foot] = Layout::vertical([
        Constraint::Length(4),
        Constraint::Length(height),
        Constraint::Min(5),
        Constraint::Length(9),
        Constraint::Length(1),
    ])
    .areas(frame.area());
    let [nodes, losses] =
        Layout::horizontal([Constraint::Percentage(60), Constraint::Percentage(40)]).areas(below);
    let table = locations(view, places.height);
    frame.render_widget(summary(view), head);
    frame.render_widget(troubles(view), wrong);
    if location_rows(view).is_empty() {
        frame.render_widget(guide(view), places);
    } else {
        frame.render_widget(table, places);
    }
    frame.render_widget(vehicles(view), nodes);
    frame.render_widget(counted(view), losses);
    frame.render_widget(Line::from(" q: quit, arrow keys: scroll").dim(), foot);
}

fn summary(view: &CellView) -> Paragraph<'_> {
    let leader = match (view.leadership.leader(), &view.leadership.epoch) {
        (Some(leader), Some(epoch)) => {
            let since = view
                .history
                .back()
                .filter(|(newest, _)| newest == epoch)
                .map_or_else(String::new, |(_, at)| {
                    format!(", seen for {}", in_words(view.now.since(*at)))
                });
            let standby = view
                .leadership
                .standby
                .as_ref()
                .map_or_else(String::new, |name| format!(", next {name}"));
            Span::from(format!(
                "{leader} leads in term {}{since}{standby}",
                epoch.term
            ))
            .bold()
        }
        _ => Span::from("no leader").bold().red(),
    };
    let freshness = match view
        .newest_round()
        .map(|(_, received_at)| view.now.since(received_at))
    {
        Some(age) if view.patience.is_some_and(|patience| age > patience) => {
            Span::from(format!("STALE: no round for {}", in_words(age)))
                .bold()
                .red()
        }
        Some(age) => Span::from(format!("newest round {} ms old", age.as_millis())).green(),
        None => Span::from("no round yet").yellow(),
    };
    let epochs: Vec<_> = view
        .history
        .iter()
        .rev()
        .skip(1)
        .map(|(epoch, _)| epoch.to_string())
        .collect();
    let before = if epochs.is_empty() {
        String::new()
    } else {
        format!("  before: {}", epochs.join(", "))
    };
    let lines = vec![
        Line::from(vec![leader, "  ".into(), freshness]),
        Line::from(before).dim(),
    ];
    Paragraph::new(lines).block(Block::bordered().title(format!(" cell {} ", view.cell)))
}

/// The first troubles with their remedies.
fn troubles(view: &CellView) -> Paragraph<'_> {
    let lines = view.troubles.iter().take(MAX_TROUBLES).flat_map(
        |(
            by,
            Trouble {
                about,
                cause,
                remedy,
                ..
            },
        )| {
            let by = by.as_ref().map(NodeName::as_str);
            let about = about.as_deref().or(by).unwrap_or("this observer");
            [
                Line::from(format!("{about}: {cause}")).yellow(),
                Line::from(format!("  -> {remedy}")).dim(),
            ]
        },
    );
    let title = match view.troubles.len() {
        all if all > MAX_TROUBLES => format!(" {MAX_TROUBLES} of {all} troubles "),
        _ => " troubles ".to_owned(),
    };
    Paragraph::new(lines.collect::<Vec<_>>()).block(Block::bordered().title(title))
}

/// Table of locations and objects that fits a box of this height.
fn locations(view: &mut CellView, height: u16) -> Table<'static> {
    // Borders and header take three lines.
    let room = usize::from(height.saturating_sub(3)).max(1);
    let rows = location_rows(view);
    view.scroll = view.scroll.min(rows.len().saturating_sub(room));
    let first = view.scroll;
    let last = rows.len().min(view.scroll + room);
    let title = match rows.len() {
        all if all > room => format!(" what is where, {} to {last} of {all} ", first + 1),
        _ => " what is where ".to_owned(),
    };
    let widths = [16, 16, 6, 16, 7]
        .map(Constraint::Length)
        .into_iter()
        .chain([Constraint::Fill(1)]);
    let head =
        Row::new(["place", "what", "sure", "voted", "lead", "seen by"]).style(Style::new().bold());
    Table::new(rows.into_iter().skip(first).take(room), widths)
        .header(head)
        .block(Block::bordered().title(title))
}

/// The next step of a user whose cell has no reports.
fn guide(view: &CellView) -> Paragraph<'_> {
    Paragraph::new(view.guide.as_str())
        .wrap(Wrap { trim: true })
        .block(Block::bordered().title(" what is where "))
}

fn location_rows(view: &CellView) -> Vec<Row<'static>> {
    let verdicts = || {
        view.verdicts
            .iter()
            .flat_map(|received| &received.message.verdicts)
    };
    let landmarks = || view.map.iter().flat_map(|received| &received.map.landmarks);
    let row = |place: String,
               label: &str,
               confidence: Option<f64>,
               verdict: Option<&Verdict>,
               by: &[NodeName]| {
        let voted = verdict.map_or("", |verdict| verdict.label.as_deref().unwrap_or("-"));
        let [confidence, margin] = [confidence, verdict.map(|verdict| verdict.margin)]
            .map(|number| number.map_or_else(String::new, |number| format!("{number:.2}")));
        let by = by
            .iter()
            .map(NodeName::as_str)
            .collect::<Vec<_>>()
            .join(" ");
        Row::new([
            place,
            label.to_owned(),
            confidence,
            voted.to_owned(),
            margin,
            by,
        ])
    };
    let mapped = landmarks().map(|entry| {
        let verdict = verdicts().find(|verdict| verdict.landmark == entry.id);
        let nothing = if entry.observers.is_empty() {
            "unknown"
        } else {
            "empty"
        };
        let label = entry.label.as_deref().unwrap_or(nothing);
        row(
            entry.id.to_string(),
            label,
            Some(entry.confidence),
            verdict,
            &entry.contributors,
        )
    });
    let voted_only = verdicts()
        .filter(|verdict| landmarks().all(|entry| entry.id != verdict.landmark))
        .map(|verdict| {
            row(
                verdict.landmark.to_string(),
                "",
                None,
                Some(verdict),
                &verdict.contributors,
            )
        });
    let objects = view
        .map
        .iter()
        .flat_map(|received| &received.map.objects)
        .map(|object| {
            let place = format!("{:.1}, {:.1} m", object.x_m, object.y_m);
            row(
                place,
                &object.label,
                Some(object.confidence),
                None,
                &object.contributors,
            )
        });
    mapped.chain(voted_only).chain(objects).collect()
}

fn vehicles(view: &CellView) -> Table<'_> {
    let reputations = view
        .reputations
        .as_ref()
        .map(|received| &received.message.reputations);
    let trusted = |node: &NodeName| {
        reputations
            .and_then(|reputations| reputations.get(node))
            .map_or_else(String::new, |it| {
                format!("{:.2} {}+ {}-", it.score, it.correct, it.incorrect)
            })
    };
    let members = view.members.iter().map(|member| {
        let part = match &view.leadership {
            it if it.leader() == Some(&member.name) => "leads",
            it if it.standby.as_ref() == Some(&member.name) => "next",
            _ => "",
        };
        Row::new([
            member.name.to_string(),
            member.role.to_string(),
            part.to_owned(),
            trusted(&member.name),
        ])
    });
    // Vehicles that are connected over MQTT only.
    let is_member = |node: &NodeName| view.members.iter().any(|member| member.name == *node);
    let others = reputations
        .into_iter()
        .flat_map(|reputations| reputations.keys())
        .filter(|node| !is_member(node))
        .map(|node| {
            Row::new([
                node.to_string(),
                "mqtt".to_owned(),
                String::new(),
                trusted(node),
            ])
        });
    let rows: Vec<_> = members.chain(others).collect();
    let title = format!(
        " {} node{} ",
        rows.len(),
        if rows.len() == 1 { "" } else { "s" }
    );
    let widths = [
        Constraint::Fill(1),
        Constraint::Length(5),
        Constraint::Length(6),
        Constraint::Length(20),
    ];
    let head = Row::new(["node", "role", "", "trust, right+ wrong-"]).style(Style::new().bold());
    Table::new(rows, widths)
        .header(head)
        .block(Block::bordered().title(title))
}

fn counted(view: &CellView) -> Table<'_> {
    // Copies that arrive over a second path are not losses.
    const COPIES: &str = "out_of_order";
    const SHOWN: [&str; 5] = [
        "inbox_full",
        "publish_refused",
        "disconnected",
        "connect_failed",
        "record_dropped",
    ];
    let events = view
        .counters
        .events
        .iter()
        .filter(|(name, _)| SHOWN.contains(name));
    let rejects = view
        .counters
        .rejects
        .iter()
        .filter(|(name, _)| **name != COPIES);
    let counts = events
        .chain(rejects)
        .chain(&view.counters.shed)
        .filter(|(_, times)| **times > 0);
    let rows: Vec<_> = counts
        .map(|(name, times)| Row::new([name.replace('_', " "), times.to_string()]))
        .collect();
    let title = if rows.is_empty() {
        " nothing lost here "
    } else {
        " lost here "
    };
    Table::new(rows, [Constraint::Fill(1), Constraint::Length(10)])
        .block(Block::bordered().title(title))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ecod::leadership::Position;
    use ecod::wire::{GlobalMap, LandmarkState, Role, SCHEMA_VERSION};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::*;
    use crate::telemetry::counters::{Counters, ShedReason};

    fn name(text: &str) -> NodeName {
        NodeName::new(text).unwrap()
    }

    fn view(now: Timestamp) -> CellView {
        let entry = LandmarkState {
            id: "slot-0".into(),
            label: Some("car".into()),
            confidence: 0.93,
            x_m: 0.0,
            y_m: 0.0,
            contributors: vec![name("gauss")],
            observers: Vec::new(),
            readings: Vec::new(),
        };
        let map: GlobalMap = serde_json::from_value(serde_json::json!({
            "schema": SCHEMA_VERSION, "aggregator": "euclid", "epoch": 4, "round": 9, "fused_at_us": 0,
            "landmarks": [entry, LandmarkState { id: "slot-1".into(), label: None, ..entry.clone() }],
            "objects": [{
                "id": uuid::Uuid::nil(), "label": "van", "confidence": 0.8, "x_m": 12.4, "y_m": -3.1,
                "covariance_m2": [0.04, 0.0, 0.04], "contributors": ["gauss"]
            }]
        }))
        .unwrap();
        let reputations: Reputations = serde_json::from_value(serde_json::json!({
            "schema": SCHEMA_VERSION, "epoch": 4, "round": 9,
            "reputations": {"hertz": {"score": 0.62, "correct": 41, "incorrect": 22}}
        }))
        .unwrap();
        let epoch = Epoch::new(4, name("euclid"));
        let mut view = CellView {
            cell: name("lot-1"),
            patience: Some(Duration::from_secs(3)),
            now,
            leadership: Leadership {
                position: Position::Following,
                term: epoch.term,
                epoch: Some(epoch),
                standby: Some(name("gauss")),
                is_deserted: false,
                is_yielding: false,
            },
            history: [(Epoch::new(3, name("edge")), Timestamp(0))].into(),
            guide: "no vehicle reports yet: run this".into(),
            members: vec![Member {
                name: name("gauss"),
                run: 0,
                gossip: "127.0.0.1:1".parse().unwrap(),
                broker: None,
                role: Role::Auto,
                certificate: None,
            }],
            map: Some(ReceivedMap {
                received_at: Timestamp(7_000_000),
                map: Arc::new(map),
            }),
            verdicts: None,
            reputations: Some(Received {
                received_at: Timestamp(7_000_000),
                message: Arc::new(reputations),
            }),
            troubles: Vec::new(),
            counters: Counters::default().snapshot(),
            scroll: 0,
        };
        view.update_history();
        view
    }

    fn shown(view: &mut CellView, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| draw(frame, view)).unwrap();
        terminal.backend().to_string()
    }

    #[test]
    fn leader_and_nodes_are_shown() {
        let text = shown(&mut view(Timestamp(7_200_000)), 100, 30);
        for part in [
            "cell lot-1",
            "euclid leads in term 4",
            "next gauss",
            "newest round 200 ms old",
            "slot-0",
            "car",
            "0.93",
            "before: edge@3",
            "slot-1           unknown",
            "12.4, -3.1 m     van",
            " 2 nodes ",
            "mqtt         0.62 41+ 22-",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(
            text.contains("nothing lost here") && !text.contains("STALE"),
            "{text}"
        );
    }

    #[test]
    fn troubles_are_shown_with_remedies() {
        let mut view = view(Timestamp(7_200_000));
        assert!(!shown(&mut view, 100, 40).contains("troubles"));
        let trouble = |n: usize| Trouble {
            kind: "clock_off".into(),
            about: (n > 0).then(|| format!("v{n}")),
            cause: "its clock is 5.0 s ahead of the cell's time".into(),
            remedy: "run a time service".into(),
        };
        view.troubles = (0..6).map(|n| (Some(name("edge")), trouble(n))).collect();
        let text = shown(&mut view, 100, 40);
        for part in [
            "4 of 6 troubles",
            "edge: its clock is 5.0 s ahead",
            "v3: its clock",
            "-> run a time service",
            "slot-0",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn old_round_shows_as_stale() {
        assert!(
            shown(&mut view(Timestamp(10_000_000)), 100, 30).contains("newest round 3000 ms old")
        );
        assert!(
            shown(&mut view(Timestamp(12_000_000)), 100, 30).contains("STALE: no round for 5 s")
        );
        let mut by_packets = CellView {
            patience: None,
            ..view(Timestamp(12_000_000))
        };
        assert!(shown(&mut by_packets, 100, 30).contains("newest round 5000 ms old"));
        let mut alone = CellView {
            leadership: Leadership::default(),
            map: None,
            ..view(Timestamp(0))
        };
        let text = shown(&mut alone, 100, 30);
        assert!(
            text.contains("no leader") && text.contains("no round yet"),
            "{text}"
        );
    }

    #[test]
    fn voting_cell_uses_verdict_age() {
        let verdicts: Verdicts = serde_json::from_value(serde_json::json!({
            "schema": SCHEMA_VERSION, "aggregator": "euclid", "epoch": 4, "round": 9, "fused_at_us": 0, "verdicts": []
        }))
        .unwrap();
        let verdicts = Some(Received {
            received_at: Timestamp(6_900_000),
            message: Arc::new(verdicts),
        });
        let history = [(Epoch::new(3, name("edge")), Timestamp(0))].into();
        for (now_us, freshness) in [
            (7_200_000, "newest round 300 ms old"),
            (12_000_000, "STALE: no round for 5 s"),
        ] {
            let verdicts = verdicts.clone();
            let history = VecDeque::clone(&history);
            let mut voting = CellView {
                map: None,
                verdicts,
                history,
                ..view(Timestamp(now_us))
            };
            voting.update_history();
            let text = shown(&mut voting, 100, 30);
            assert!(
                text.contains(freshness) && text.contains("before: edge@3"),
                "{text}"
            );
        }
    }

    #[test]
    fn overload_losses_are_counted() {
        let counters = Counters::default();
        for vehicle in ["euclid", "gauss"] {
            counters.shed(ShedReason::ReportReplaced, vehicle);
        }
        let text = shown(
            &mut CellView {
                counters: counters.snapshot(),
                ..view(Timestamp(7_200_000))
            },
            100,
            30,
        );
        assert!(
            text.contains(" lost here ") && text.contains("report replaced"),
            "{text}"
        );
    }

    #[test]
    fn hidden_rows_are_scrollable() {
        // Two locations and an object, and room for two lines.
        let mut view = view(Timestamp(7_200_000));
        let height = 4 + 5 + 9 + 1;
        let text = shown(&mut view, 100, height);
        assert!(
            text.contains("what is where, 1 to 2 of 3") && !text.contains("van"),
            "{text}"
        );
        view.scroll += 40;
        let text = shown(&mut view, 100, height);
        assert!(
            text.contains("what is where, 2 to 3 of 3") && text.contains("van"),
            "{text}"
        );
        assert_eq!(view.scroll, 1);
    }

    #[test]
    fn small_terminal_is_accepted() {
        for (width, height) in [(1, 1), (20, 5), (40, 12)] {
            shown(&mut view(Timestamp(0)), width, height);
        }
    }

    #[test]
    fn empty_cell_shows_next_step() {
        let now = Timestamp(0) + Duration::from_secs(9);
        let mut view = CellView {
            map: None,
            verdicts: None,
            ..view(now)
        };
        let shown = shown(&mut view, 80, 30);
        assert!(
            shown.contains("no vehicle reports yet: run this"),
            "{shown}"
        );
    }
}
