//! Files of the page, compiled into the program.

/// A file of the page.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asset {
    path: &'static str,
    pub(crate) content_type: &'static str,
    pub(crate) content: &'static str,
}

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

const ASSETS: [Asset; 21] = [
    asset("/", HTML, include_str!("page/index.html")),
    asset("/view.css", CSS, VIEW_STYLE),
    asset("/style.css", CSS, include_str!("page/style.css")),
    asset("/icon.svg", SVG, include_str!("page/icon.svg")),
    asset("/main.js", SCRIPT, include_str!("page/main.js")),
    asset("/live.js", SCRIPT, include_str!("page/live.js")),
    asset("/camera.js", SCRIPT, include_str!("page/camera.js")),
    asset("/mount.js", SCRIPT, include_str!("page/mount.js")),
    asset("/scene.js", SCRIPT, include_str!("page/scene.js")),
    asset("/timeline.js", SCRIPT, include_str!("page/timeline.js")),
    asset("/map.js", SCRIPT, include_str!("page/map.js")),
    asset("/fit.js", SCRIPT, include_str!("page/fit.js")),
    asset("/labels.js", SCRIPT, include_str!("page/labels.js")),
    asset("/earth.js", SCRIPT, include_str!("page/earth.js")),
    asset("/floor.js", SCRIPT, include_str!("page/floor.js")),
    asset("/trails.js", SCRIPT, include_str!("page/trails.js")),
    asset("/details.js", SCRIPT, include_str!("page/details.js")),
    asset("/terms.js", SCRIPT, include_str!("page/terms.js")),
    asset("/tables.js", SCRIPT, include_str!("page/tables.js")),
    asset("/charts.js", SCRIPT, include_str!("page/charts.js")),
    asset("/dom.js", SCRIPT, include_str!("page/dom.js")),
];

const fn asset(path: &'static str, content_type: &'static str, content: &'static str) -> Asset {
    Asset {
        path,
        content_type,
        content,
    }
}

/// Paths of all files of the page, the page itself first.
pub fn paths() -> impl Iterator<Item = &'static str> {
    ASSETS.iter().map(|asset| asset.path)
}

/// Content type and content of a file of the page, for pages of the same look.
pub fn page_file(path: &str) -> Option<(&'static str, &'static str)> {
    Asset::find(path).map(|asset| (asset.content_type, asset.content))
}

/// Style sheet of map and timeline, with the colours of all pages.
pub(crate) const VIEW_STYLE: &str = include_str!("page/view.css");

/// Map and timeline of the page in HTML, with the element ids that the scripts use.
pub(crate) fn view() -> &'static str {
    let page = include_str!("page/index.html")
        .split("<!-- map and timeline, also of reports -->")
        .nth(1);
    page.and_then(|rest| rest.split("<!-- end -->").next())
        .unwrap_or_default()
}

/// The scripts that draw map and timeline, as one script without imports. Their top-level names
/// must be distinct.
pub(crate) fn view_script() -> String {
    const PATHS: [&str; 12] = [
        "/dom.js",
        "/scene.js",
        "/terms.js",
        "/fit.js",
        "/labels.js",
        "/earth.js",
        "/floor.js",
        "/trails.js",
        "/details.js",
        "/tables.js",
        "/map.js",
        "/timeline.js",
    ];
    let scripts = PATHS.into_iter().filter_map(Asset::find);
    let lines = scripts
        .flat_map(|script| script.content.lines())
        .filter(|line| !line.starts_with("import "));
    lines
        .map(|line| line.strip_prefix("export ").unwrap_or(line).to_owned() + "\n")
        .collect()
}

impl Asset {
    /// The file at a path of the page.
    pub(crate) fn find(path: &str) -> Option<Self> {
        ASSETS.into_iter().find(|asset| asset.path == path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_is_whole_and_small() {
        let bytes: usize = ASSETS.iter().map(|asset| asset.content.len()).sum();
        println!(
            "page: {bytes} bytes in {} files, uncompressed",
            ASSETS.len()
        );
        assert!(bytes < 150_000);
        for asset in ASSETS {
            let imports = asset
                .content
                .split("from \"./")
                .skip(1)
                .filter_map(|rest| rest.split('"').next());
            for import in imports {
                assert!(
                    Asset::find(&format!("/{import}")).is_some(),
                    "{} imports {import}",
                    asset.path
                );
            }
        }
    }

    #[test]
    fn report_includes_map_and_timeline() {
        let view = view();
        let script = view_script();
        for id in [
            "map",
            "map-table",
            "timeline-bands",
            "timeline-cursor",
            "timeline-events",
        ] {
            assert!(view.contains(&format!("id=\"{id}\"")), "{id}");
        }
        assert!(!script.contains("import ") && !script.contains("\nexport "));
        let declared = |line: &'static str| {
            let rest = ["const ", "let ", "function ", "class "]
                .iter()
                .find_map(|word| line.strip_prefix(word))?;
            rest.split(|letter: char| !letter.is_alphanumeric() && letter != '_')
                .next()
        };
        let mut names = std::collections::BTreeSet::new();
        for line in String::leak(script).lines() {
            assert!(
                declared(line).is_none_or(|name| name.is_empty() || names.insert(name)),
                "{line}"
            );
        }
    }

    #[test]
    fn page_has_no_foreign_content() {
        for asset in ASSETS {
            for forbidden in ["https://", "style=", "onclick=", "innerHTML", "eval("] {
                assert!(
                    !asset.content.contains(forbidden),
                    "{}: {forbidden}",
                    asset.path
                );
            }
        }
    }
}
