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

const ASSETS: [Asset; 9] = [
    asset("/", HTML, include_str!("page/index.html")),
    asset("/style.css", CSS, include_str!("page/style.css")),
    asset("/icon.svg", SVG, include_str!("page/icon.svg")),
    asset("/main.js", SCRIPT, include_str!("page/main.js")),
    asset("/live.js", SCRIPT, include_str!("page/live.js")),
    asset("/map.js", SCRIPT, include_str!("page/map.js")),
    asset("/tables.js", SCRIPT, include_str!("page/tables.js")),
    asset("/charts.js", SCRIPT, include_str!("page/charts.js")),
    asset("/dom.js", SCRIPT, include_str!("page/dom.js")),
];

const fn asset(path: &'static str, content_type: &'static str, content: &'static str) -> Asset {
    Asset { path, content_type, content }
}

/// Paths of all files of the page, the page itself first.
pub fn paths() -> impl Iterator<Item = &'static str> {
    ASSETS.iter().map(|asset| asset.path)
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
    fn the_page_is_small_even_uncompressed_and_whole() {
        let bytes: usize = ASSETS.iter().map(|asset| asset.content.len()).sum();
        println!("page: {bytes} bytes in {} files, uncompressed", ASSETS.len());
        assert!(bytes < 150_000);
        for asset in ASSETS {
            let imports = asset.content.split("from \"./").skip(1).filter_map(|rest| rest.split('"').next());
            for import in imports {
                assert!(Asset::find(&format!("/{import}")).is_some(), "{} imports {import}", asset.path);
            }
        }
    }

    #[test]
    fn nothing_is_inline_or_from_elsewhere() {
        for asset in ASSETS {
            for forbidden in ["https://", "style=", "onclick=", "innerHTML", "eval("] {
                assert!(!asset.content.contains(forbidden), "{}: {forbidden}", asset.path);
            }
        }
    }
}
