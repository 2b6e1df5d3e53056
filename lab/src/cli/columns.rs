//! Text tables.

/// Rows under a header, the first column left-aligned and the others right-aligned.
pub(super) fn columns(rows: &[Vec<String>]) -> String {
    let count = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter()
            .filter_map(|row| row.get(column))
            .map(|cell| cell.chars().count())
            .max()
            .unwrap_or(0)
    };
    let widths: Vec<usize> = (0..count).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
            let padding = " ".repeat(width - cell.chars().count());
            line += &if column == 0 {
                format!("{cell}{padding}")
            } else {
                format!("  {padding}{cell}")
            };
        }
        text += line.trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tracks::percent;

    #[test]
    fn numbers_end_in_one_column() {
        let rows = [
            vec!["name".into(), "%".into()],
            vec!["é".into(), percent(Some(12.345))],
            vec!["x".into(), percent(None)],
        ];
        assert_eq!(columns(&rows), "name      %\né     12.35\nx         -\n");
    }
}
