//! The JSON Schemas in `docs/schemas` match the code, and `docs/asyncapi.yaml` has its topics.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::wire::{RegionTopic, RegionTopicKind, Topic, Topics};

const REGENERATE: &str = "regenerate with: INSTA_UPDATE=always make snapshots";

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs")
}

#[test]
fn documented_schemas_match_code() {
    let directory = docs().join("schemas");
    let schemas = ecod::wire::schemas();
    for (name, schema) in &schemas {
        let file = directory.join(format!("{name}.json"));
        let current = serde_json::to_string_pretty(schema).unwrap() + "\n";
        if std::env::var("INSTA_UPDATE").is_ok_and(|value| value == "always") {
            std::fs::write(&file, &current).unwrap();
        }
        let documented = std::fs::read_to_string(&file).unwrap_or_default();
        assert!(
            documented == current,
            "{} is out of date; {REGENERATE}",
            file.display()
        );
    }
    let documented = std::fs::read_dir(&directory).unwrap().count();
    assert_eq!(
        documented,
        schemas.len(),
        "a schema of no payload in {}",
        directory.display()
    );
}

/// The text after `before` in a line, up to `end`.
fn values<'a>(text: &'a str, before: &'a str, end: char) -> BTreeSet<&'a str> {
    let rest = text.lines().filter_map(|line| line.split_once(before));
    rest.map(|(_, rest)| rest.split(end).next().unwrap_or(rest))
        .collect()
}

/// `make asyncapi-check` sees to the rest of the document.
#[test]
fn asyncapi_covers_topics_and_schemas() {
    let document = std::fs::read_to_string(docs().join("asyncapi.yaml")).unwrap();
    let node = NodeName::from_static("node");
    let topics = Topics::new(&NodeName::from_static("cell"));
    let kinds = [
        Topic::Detections(node.clone()),
        Topic::VoteDetections(node.clone()),
        Topic::Boxes(node.clone()),
        Topic::GlobalDetections,
        Topic::GlobalVerdicts,
        Topic::Reputations,
        Topic::Cell,
        Topic::Ledger(node.clone()),
        Topic::Nodes(node.clone()),
    ];
    let spoken = kinds
        .iter()
        .map(|topic| topics.path(topic))
        .chain([topics.clients(&node)]);
    let spoken: BTreeSet<String> = spoken
        .chain(["global", "node", "received/{receiver}"].map(|level| topics.cpm(level)))
        .collect();
    let tile: Quadkey = "0".parse().unwrap();
    let of_region = RegionTopicKind::ALL.map(|kind| RegionTopic {
        tile,
        cell: NodeName::from_static("cell"),
        kind,
    });
    let spoken = &spoken | &of_region.iter().map(RegionTopic::path).collect();
    let addresses = values(&document, "address: ", '\n');
    let documented: BTreeSet<_> = addresses
        .iter()
        .map(|address| {
            address
                .replace("{cell}", "cell")
                .replace("{node}", "node")
                .replace("{tile}", "0")
        })
        .collect();
    assert_eq!(documented, spoken);
    let schemas = ecod::wire::schemas();
    let files: BTreeSet<_> = schemas.keys().map(|name| format!("{name}.json")).collect();
    let referenced = values(&document, "$ref: 'schemas/", '\'')
        .into_iter()
        .map(str::to_owned)
        .collect();
    assert_eq!(files, referenced);
}
