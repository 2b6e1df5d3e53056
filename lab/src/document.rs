//! Tables that measuring programs write into a document of the manual.

use std::fs;
use std::path::Path;

use anyhow::Context;

/// Replaces the text between the lines `<!-- NAME table begin -->` and `<!-- NAME table end -->`
/// of a document.
///
/// # Errors
/// Fails with the path of the document if that lacks the lines, or cannot be read or written.
pub fn write_table(document: &Path, name: &str, table: &str) -> anyhow::Result<()> {
    let in_document = || document.display().to_string();
    let begin = format!("<!-- {name} table begin -->\n");
    let end = format!("<!-- {name} table end -->");
    let text = fs::read_to_string(document).with_context(in_document)?;
    let written = replace(&text, &begin, &end, table)
        .with_context(|| format!("{}: has no {begin}and {end}", document.display()))?;
    fs::write(document, written).with_context(in_document)
}

fn replace(text: &str, begin: &str, end: &str, table: &str) -> Option<String> {
    let (before, rest) = text.split_once(begin)?;
    let (_, after) = rest.split_once(end)?;
    Some(format!("{before}{begin}{table}{end}{after}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_named_table_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let document = directory.path().join("results.md");
        let text = |table: &str| {
            format!(
                "# Results\n<!-- a table begin -->\n| 1 |\n<!-- a table end -->\n\
                 <!-- b table begin -->\n{table}<!-- b table end -->\nend\n"
            )
        };
        fs::write(&document, text("| 2 |\n")).unwrap();
        write_table(&document, "b", "| 3 |\n| 4 |\n").unwrap();
        assert_eq!(
            fs::read_to_string(&document).unwrap(),
            text("| 3 |\n| 4 |\n")
        );
        let error = write_table(&document, "c", "| 5 |\n").unwrap_err();
        assert!(
            error.to_string().contains("<!-- c table begin -->"),
            "{error}"
        );
    }
}
