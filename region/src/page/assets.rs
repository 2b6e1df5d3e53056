//! Files of the page, compiled into the program.

use ecod_actors::observe::dashboard::page_file;

/// Files that are this page's own: path, content type, content.
const OWN: [(&str, &str, &str); 4] = [
    ("/", "text/html; charset=utf-8", include_str!("index.html")),
    (
        "/region.css",
        "text/css; charset=utf-8",
        include_str!("region.css"),
    ),
    (
        "/region.js",
        "text/javascript; charset=utf-8",
        include_str!("region.js"),
    ),
    (
        "/town.js",
        "text/javascript; charset=utf-8",
        include_str!("town.js"),
    ),
];

/// Files of a node's page that this one has, too.
const SHARED: [&str; 4] = ["/view.css", "/style.css", "/dom.js", "/icon.svg"];

/// Content type and content of the file at a path.
pub(super) fn find(path: &str) -> Option<(&'static str, &'static str)> {
    if SHARED.contains(&path) {
        return page_file(path);
    }
    OWN.into_iter()
        .find(|(own, ..)| *own == path)
        .map(|(_, content_type, content)| (content_type, content))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_has_no_foreign_content() {
        for (path, _, content) in OWN {
            for forbidden in ["https://", "style=", "onclick=", "innerHTML", "eval("] {
                assert!(!content.contains(forbidden), "{path}: {forbidden}");
            }
            for start in ["from \"./", "href=\"/", "src=\"/"] {
                for file in content
                    .split(start)
                    .skip(1)
                    .filter_map(|rest| rest.split('"').next())
                {
                    let is_served = ["api/view", "metrics", "healthz"].contains(&file);
                    assert!(
                        is_served || find(&format!("/{file}")).is_some(),
                        "{path} names {file}"
                    );
                }
            }
        }
    }
}
