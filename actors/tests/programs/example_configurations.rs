//! The example configurations of the documentation work unchanged, and the files that they name exist.

use std::collections::BTreeMap;
#[cfg(feature = "camera")]
use std::io::Write;
use std::path::Path;

use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_testkit::example;

fn load(name: &str) -> NodeConfig {
    let file = example(&format!("node/{name}"));
    NodeConfig::load(Some(&file), &BTreeMap::<(), ()>::new())
        .unwrap_or_else(|error| panic!("{}: {error}", file.display()))
}

#[test]
fn example_edge_aggregates_for_network() {
    let edge = load("edge.toml");
    assert_eq!(edge.role, Role::Edge);
    assert!(edge.broker_listen().ip().is_unspecified());
    assert!(edge.mqtt.broker.is_none());
}

/// `doctor`, which systemd does not start, checks the directory to which the service writes.
#[test]
fn packaged_node_uses_service_directory() {
    let node = load("../../packaging/debian/node.toml");
    let unit = include_str!("../../../packaging/systemd/ecod-node.service");
    let directory = node.state_dir.expect("none is named");
    let name = directory
        .strip_prefix("/var/lib")
        .unwrap()
        .display()
        .to_string();
    let has = |line: String| unit.lines().any(|found| found == line);
    assert!(
        has(format!("StateDirectory={name}"))
            && has(format!("WorkingDirectory={}", directory.display()))
    );
}

#[cfg(feature = "camera")]
#[test]
fn example_vehicles_fit_example_edge() {
    let edge = load("edge.toml");
    for (file, role) in [("auto.toml", Role::Auto), ("cav.toml", Role::Cav)] {
        let vehicle = load(file);
        assert_eq!(vehicle.role, role);
        assert_eq!(vehicle.cell, edge.cell);
        assert_eq!(vehicle.membership, edge.membership);
        let description = std::fs::read_to_string(example("node/cell.toml")).unwrap();
        let described = vehicle.described(&description).unwrap();
        let edge = edge.described(&description).unwrap();
        assert_eq!(
            (&described.landmarks, &described.fusion),
            (&edge.landmarks, &edge.fusion)
        );
        assert!(
            described.landmarks.len() == 3
                && described.origin == edge.origin
                && edge.origin.is_some()
        );
        assert!(
            described
                .camera
                .unwrap()
                .projection
                .sizes
                .of("car")
                .is_some()
        );
        assert_eq!(
            vehicle.landmarks,
            [],
            "a node's own file contains no shared settings"
        );
        assert!(
            vehicle.broker_listen().ip().is_unspecified(),
            "the others reach its broker"
        );
        assert!(vehicle.camera.is_some());
    }
}

/// Keys of a configuration that are no tables.
#[cfg(feature = "camera")]
fn leaves(table: &toml::Table, path: &str) -> Vec<String> {
    let below = |(key, value): (&String, &toml::Value)| match value {
        toml::Value::Table(inner) => leaves(inner, &format!("{path}{key}.")),
        _ => vec![format!("{path}{key}")],
    };
    table.iter().flat_map(below).collect()
}

#[cfg(feature = "camera")]
#[test]
fn example_sets_only_common_keys() {
    let manual = page("docs/configuration.md");
    let first = manual.split("\n## ").nth(1).unwrap();
    let cells = first
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split_once(" | "));
    let mut explained: Vec<&str> = cells
        .flat_map(|(keys, _)| keys.trim_end_matches('`').split("`, `"))
        .collect();
    explained.sort_unstable();
    let text = std::fs::read_to_string(example("node/auto.toml")).unwrap();
    let mut set = leaves(&text.parse().unwrap(), "");
    set.sort_unstable();
    assert_eq!(
        (explained.len(), explained),
        (15, set.iter().map(String::as_str).collect())
    );
    let mut changed = leaves(
        &load("auto.toml")
            .to_toml_changed()
            .unwrap()
            .parse()
            .unwrap(),
        "",
    );
    changed.sort_unstable();
    set.retain(|key| key != "role");
    assert_eq!(changed, set, "the role is the default one");
}

#[cfg(feature = "camera")]
#[test]
fn documented_configurations_are_valid() {
    let manual = [
        "README.md",
        "docs/configuration.md",
        "docs/cameras.md",
        "docs/operations.md",
        "docs/dashboard.md",
    ];
    let manual = manual.map(page).concat();
    let blocks: Vec<&str> = manual
        .split("```toml\n")
        .skip(1)
        .map(|rest| rest.split_once("```").unwrap().0)
        .collect();
    assert!(blocks.len() >= 10, "only {} blocks found", blocks.len());
    for block in blocks {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "name = \"n\"\nrole = \"edge\"\n{block}\n").unwrap();
        for (key, value) in [
            ("source", "kind = \"v4l2\""),
            ("detector", "kind = \"coco\""),
        ] {
            if block.contains("[camera") && !block.contains(&format!("[camera.{key}]")) {
                writeln!(file, "[camera.{key}]\n{value}").unwrap();
            }
        }
        let loaded = NodeConfig::load(Some(file.path()), &BTreeMap::<(), ()>::new());
        assert!(loaded.is_ok(), "{block}\n{}", loaded.unwrap_err());
    }
}

#[cfg(feature = "camera")]
#[test]
fn the_documentation_names_every_key() {
    let manual = page("docs/configuration.md") + &page("docs/cameras.md");
    let description = std::fs::read_to_string(example("node/cell.toml")).unwrap();
    let config = toml::to_string(&load("cav.toml").described(&description).unwrap()).unwrap();
    let keys = config
        .lines()
        .filter_map(|line| Some(line.split_once(" = ")?.0.trim()));
    for key in keys {
        let named = [
            format!("`{key}`"),
            format!(".{key}`"),
            format!("`{key} = "),
            format!(".{key} = "),
            format!("\n{key} = "),
        ]
        .iter()
        .any(|name| manual.contains(name));
        assert!(
            named,
            "neither docs/configuration.md nor docs/cameras.md names `{key}`"
        );
    }
}

#[test]
fn documentation_links_resolve() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let docs = std::fs::read_dir(root.join("docs"))
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let pages = docs.filter(|path| path.extension().is_some_and(|end| end == "md"));
    let pages: Vec<_> = pages
        .chain(["README.md", "CHANGELOG.md"].map(|name| root.join(name)))
        .collect();
    let mut followed = 0;
    for page in &pages {
        let text = std::fs::read_to_string(page).unwrap();
        let links = text
            .split("](")
            .skip(1)
            .filter_map(|rest| Some(rest.split_once(')')?.0));
        for link in links.filter(|link| !link.starts_with("http")) {
            let (file, heading) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() {
                page.clone()
            } else {
                page.parent().unwrap().join(file)
            };
            assert!(target.exists(), "{}: {link}", page.display());
            if !heading.is_empty() {
                let target = std::fs::read_to_string(&target).unwrap();
                assert!(
                    target.lines().any(|line| anchor(line) == heading),
                    "{}: {link}",
                    page.display()
                );
            }
            followed += 1;
        }
    }
    assert!(followed > 40, "only {followed} links found");
}

/// Name of a heading in links to it.
fn anchor(line: &str) -> String {
    let Some(words) = line.strip_prefix('#') else {
        return String::new();
    };
    let kept = words.trim_start_matches('#').trim().chars();
    let kept = kept.filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
    kept.collect::<String>().to_lowercase().replace(' ', "-")
}

#[cfg(feature = "camera")]
fn page(name: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name)).unwrap()
}
