//! Results as a table for people.

use std::fmt::Write;

use super::score::SceneResult;

/// One line per scene: maps, shares of right spots, and spots that no camera sees.
pub fn table(results: &[SceneResult]) -> String {
    let mut text = String::new();
    let header = [
        "scene",
        "maps",
        "right %",
        "`paper` mode %",
        "occupied spots %",
        "best vehicle alone %",
        "if all empty %",
        "recorded %",
        "spots out of view",
    ];
    let rows: Vec<[String; COLUMNS]> = results.iter().map(row).collect();
    let mut widths = header.map(str::len);
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = (*width).max(cell.chars().count());
        }
    }
    let mut line = |cells: [&str; COLUMNS]| {
        for (index, (cell, width)) in cells.iter().zip(widths).enumerate() {
            let padding = width - cell.chars().count();
            let (before, after) = if index == 0 || index == COLUMNS - 1 {
                (0, padding)
            } else {
                (padding, 0)
            };
            // Writing to a text does not fail.
            let _ = write!(text, "{:before$}{cell}{:after$}  ", "", "");
        }
        text.truncate(text.trim_end().len());
        text.push('\n');
    };
    line(header);
    for row in &rows {
        line(row.each_ref().map(String::as_str));
    }
    text.push('\n');
    for result in results {
        let alone = result.single_cav_accuracy_pct.iter().map(|(name, pct)| {
            let recorded = result.recorded_single_cav_accuracy_pct.get(name);
            format!(
                "{name} {pct:.1}{}",
                recorded.map_or_else(String::new, |pct| format!(" (recorded {pct:.1})"))
            )
        });
        let kinds = [
            ("VOTE alone", result.vote_accuracy_pct),
            ("PACE and VOTE together", result.answer_accuracy_pct),
        ];
        let of_kinds = kinds
            .into_iter()
            .filter_map(|(kind, pct)| Some(format!("{kind} {:.2}", pct?)));
        let all: Vec<_> = alone.chain(of_kinds).collect();
        // Writing to a text does not fail.
        let _ = writeln!(
            text,
            "{}, right % by each alone: {}",
            result.name,
            all.join(", ")
        );
    }
    text
}

const COLUMNS: usize = 9;

fn row(result: &SceneResult) -> [String; COLUMNS] {
    let percent = |pct: Option<f64>| pct.map_or_else(|| "-".into(), |pct| format!("{pct:.2}"));
    let best_alone = result
        .single_cav_accuracy_pct
        .values()
        .copied()
        .max_by(f64::total_cmp);
    let unseen: Vec<&str> = result.unseen_spots.iter().map(|id| id.as_str()).collect();
    [
        result.name.clone(),
        result.verdicts.to_string(),
        percent(Some(result.pace_accuracy_pct)),
        percent(result.paper_accuracy_pct),
        percent(result.occupied_accuracy_pct),
        percent(best_alone),
        percent(Some(result.always_empty_pct)),
        percent(result.recorded_pace_accuracy_pct),
        if unseen.is_empty() {
            "-".into()
        } else {
            unseen.join(" ")
        },
    ]
}
