//! The lists of keys in docs/configuration.md match the code: descriptions are the first sentences
//! of the fields' documentation, defaults are the values of a loaded configuration, and ranges are
//! the ranges in the loader's errors.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::config::descriptions::sentences;
use serde_json::{Map, Value};

/// A configuration in which each section that has required keys has them.
const COMPLETE: &str = r#"
name = "n"
camera.source.kind = "v4l2"
camera.detector.kind = "coco"
origin = { latitude_deg = 1.0, longitude_deg = 1.0 }
record.dir = "log"
"#;

/// Sections that the manual explains by examples instead of tables.
const EXPLAINED_BY_EXAMPLES: [&str; 4] = ["camera.source", "camera.detector", "landmarks", "tls"];

fn manual() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/configuration.md")
}

/// A key of the configuration.
struct Key {
    /// Full name, such as `fusion.pace.gate_m`.
    name: String,
    /// The field's schema, with the documentation as `description`.
    schema: Map<String, Value>,
}

/// The keys below `schema`, in the order of the fields.
fn keys(schema: &Value, definitions: &Value, path: &str, found: &mut Vec<Key>) {
    let Some(fields) = schema["properties"].as_object() else {
        return;
    };
    for (field, field_schema) in fields {
        let name = if path.is_empty() {
            field.clone()
        } else {
            format!("{path}.{field}")
        };
        if EXPLAINED_BY_EXAMPLES.contains(&name.as_str()) || name == "cameras" {
            continue;
        }
        let target = referenced(field_schema, definitions);
        if target["properties"].is_object() && name != "camera.projection.sizes.default" {
            keys(target, definitions, &name, found);
        } else {
            let schema = field_schema.as_object().cloned().unwrap_or_default();
            found.push(Key { name, schema });
        }
    }
}

/// The schema to which `schema` refers, directly or as an alternative to null; otherwise itself.
fn referenced<'a>(schema: &'a Value, definitions: &'a Value) -> &'a Value {
    let alternatives = schema["anyOf"].as_array();
    let reference = alternatives
        .and_then(|all| all.iter().find_map(|one| one["$ref"].as_str()))
        .or(schema["$ref"].as_str())
        .or(schema["allOf"][0]["$ref"].as_str());
    match reference.and_then(|text| text.rsplit('/').next()) {
        Some(name) => &definitions[name],
        None => schema,
    }
}

/// The values that an enumeration allows, in TOML.
fn alternatives(schema: &Value) -> Vec<String> {
    let one_of = schema["oneOf"].as_array().into_iter().flatten();
    let constants = one_of.filter_map(|one| one["const"].as_str());
    let grouped = schema["oneOf"].as_array().into_iter().flatten();
    let listed = grouped
        .chain([schema])
        .filter_map(|one| one["enum"].as_array())
        .flatten()
        .filter_map(Value::as_str);
    constants
        .chain(listed)
        .map(|name| format!("`{name}`"))
        .collect()
}

/// Loads [`COMPLETE`] with other values of these keys.
fn load_with(values: &[(&str, toml::Value)]) -> Result<NodeConfig, String> {
    let mut root: toml::Table = COMPLETE.parse().unwrap();
    for (key, value) in values {
        let (sections, field) = key.rsplit_once('.').unwrap_or(("", key));
        let mut table = &mut root;
        for section in sections.split('.').filter(|section| !section.is_empty()) {
            table = table
                .entry(section)
                .or_insert_with(|| toml::Table::new().into())
                .as_table_mut()
                .unwrap();
        }
        table.insert(field.to_owned(), value.clone());
    }
    let mut file = tempfile::NamedTempFile::new().unwrap();
    write!(file, "{root}").unwrap();
    NodeConfig::load(Some(file.path()), &BTreeMap::<(), ()>::new())
        .map_err(|error| error.to_string())
}

/// The bounds that the loader states when it refuses this value of a key, beside a value of
/// another.
fn refused_range(
    key: &str,
    value: toml::Value,
    other: Option<(&str, toml::Value)>,
) -> Option<[String; 2]> {
    let mut values = vec![(key, value)];
    values.extend(other);
    let error = load_with(&values).err()?;
    let (place, bounds) = error.split_once("must be a number from ")?;
    let (low, high) = bounds.split_once(" to ")?;
    let high = high.split_whitespace().next()?.trim_end_matches([',', ';']);
    place
        .contains(&format!("`{key}`"))
        .then(|| [low.to_owned(), high.to_owned()])
}

/// The lowest and the highest allowed number, or the key that bounds it.
fn range(key: &Key, all: &[Key], defaults: &toml::Table) -> Option<[String; 2]> {
    let types = key.schema.get("type")?;
    let has_type = |name: &str| {
        types == name
            || types
                .as_array()
                .is_some_and(|all| all.iter().any(|one| one == name))
    };
    let beyond = if has_type("integer") {
        [
            toml::Value::Integer(1_000_000_000_000_000),
            toml::Value::Integer(0),
        ]
    } else if has_type("number") {
        [toml::Value::Float(1e300), toml::Value::Float(-1e300)]
    } else {
        return None;
    };
    for value in beyond {
        let Some(stated) = refused_range(&key.name, value.clone(), None) else {
            continue;
        };
        let bounds = [0, 1].map(|end| {
            let bounding = all.iter().find(|other| {
                let Some(moved) = default_value(defaults, &other.name).and_then(lowered) else {
                    return false;
                };
                let is_sibling = section_of(&other.name) == section_of(&key.name);
                let range = || refused_range(&key.name, value.clone(), Some((&other.name, moved)));
                is_sibling
                    && other.name != key.name
                    && range().is_some_and(|range| range[end] != stated[end])
            });
            match bounding {
                Some(other) => format!("`{}`", field_of(&other.name)),
                None => written(&stated[end]),
            }
        });
        return Some(bounds);
    }
    let bound = |name| Some(written(&key.schema.get(name)?.as_number()?.to_string()));
    Some([bound("minimum")?, bound("maximum")?])
}

/// A number that is a little smaller.
fn lowered(value: &toml::Value) -> Option<toml::Value> {
    match value {
        toml::Value::Integer(number) if *number > 1 => Some((number - 1).into()),
        toml::Value::Float(number) => Some((number * 0.9).into()),
        _ => None,
    }
}

/// The table of a key.
fn section_of(key: &str) -> &str {
    key.rsplit_once('.').map_or("", |(section, _)| section)
}

/// The name of a key in its table.
fn field_of(key: &str) -> &str {
    key.rsplit_once('.').map_or(key, |(_, field)| field)
}

/// A bound as the manual writes it: thousands are separated, and large or small powers of ten are
/// written as such.
fn written(bound: &str) -> String {
    let Ok(value) = bound.parse::<f64>() else {
        return bound.to_owned();
    };
    if value == std::f64::consts::PI {
        return "π".to_owned();
    }
    let sign = if value < 0.0 { "−" } else { "" };
    let size = value.abs();
    let exponent = size.log10().round();
    let is_power = (size.log10() - exponent).abs() < 1e-9;
    if is_power && !(-4.0..7.0).contains(&exponent) {
        let digits = "⁰¹²³⁴⁵⁶⁷⁸⁹".chars().collect::<Vec<_>>();
        let raised = exponent
            .to_string()
            .chars()
            .map(|c| match c.to_digit(10) {
                Some(digit) => digits[digit as usize],
                None => '⁻',
            })
            .collect::<String>();
        return format!("{sign}10{raised}");
    }
    let text = size.to_string();
    let (whole, rest) = text.split_at(text.find('.').unwrap_or(text.len()));
    let mut grouped = String::new();
    for (position, digit) in whole.chars().enumerate() {
        if position > 0 && whole.len() > 4 && (whole.len() - position) % 3 == 0 {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    format!("{sign}{grouped}{rest}")
}

/// Units that the ends of keys state.
const UNITS: [(&str, &str); 8] = [
    ("_mps", " in metres per second"),
    ("_m", " in metres"),
    ("_ms", " in ms"),
    ("_s", " in seconds"),
    ("_deg", " in degrees"),
    ("_rad", " in radians"),
    ("_px", " in pixels"),
    ("_bytes", " in bytes"),
];

/// A description without the unit that its key states.
fn without_unit(key: &str, description: &str) -> String {
    let unit = UNITS.iter().find(|(end, _)| key.ends_with(end));
    match unit {
        Some((_, unit)) => description
            .replace(&format!(",{unit}"), "")
            .replace(unit, ""),
        None => description.to_owned(),
    }
}

/// The documentation of a field, split into what the key means and what its default is.
fn meaning(description: &str) -> (String, Option<String>) {
    let text = description.replace("\n", " ");
    let mut default = None;
    let mut kept = Vec::new();
    for sentence in sentences(&text) {
        if let Some(rest) = sentence.strip_prefix("Default") {
            let rest = rest.trim_start_matches([':', ' ']).trim_end_matches('.');
            let rest = rest.split("; ").next().unwrap_or(rest);
            default.get_or_insert_with(|| rest.to_owned());
            continue;
        }
        if kept.is_empty() {
            let (shown, stated) = match sentence.split_once("; default") {
                Some((before, after)) => (before, Some(after)),
                None => (sentence.trim_end_matches('.'), None),
            };
            if let Some(stated) = stated {
                let stated = stated.trim_start_matches([':', ' ']).trim_end_matches('.');
                default.get_or_insert_with(|| stated.to_owned());
            }
            kept.push(shown.to_owned());
        }
    }
    (kept.join(" "), default)
}

/// The default of a key as a loaded configuration has it.
fn default_value<'a>(defaults: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
    let mut parts = key.split('.');
    let first = defaults.get(parts.next()?)?;
    parts.try_fold(first, |value, part| value.get(part))
}

/// One item of the list of a section, such as "- `beat_ms = 50` (5–10,000): Time between beats".
fn item(
    key: &Key,
    all: &[Key],
    section: &str,
    defaults: &toml::Table,
    definitions: &Value,
) -> String {
    let description = key.schema.get("description").and_then(Value::as_str);
    let (meaning, stated) = meaning(description.unwrap_or_default());
    let meaning = without_unit(&key.name, &meaning);
    let complete: toml::Table = COMPLETE.parse().unwrap();
    let is_required = default_value(&complete, &key.name).is_some();
    let value =
        default_value(defaults, &key.name).filter(|value| !value.is_array() && !is_required);
    let is_absent = |text: &str| {
        ["not set", "empty", "no "]
            .iter()
            .any(|none| text.starts_with(none))
    };
    let name = key.name.strip_prefix(section).unwrap_or(&key.name);
    let name = name.trim_start_matches('.');
    let named = match (value, stated.filter(|text| !is_absent(text))) {
        (Some(value), _) => format!("`{name} = {value}`"),
        (None, Some(stated)) => format!("`{name}`, by default {stated}"),
        (None, None) if is_required => format!("`{name}`, required"),
        (None, None) => format!("`{name}`"),
    };
    let schema = Value::Object(key.schema.clone());
    let names = alternatives(referenced(&schema, definitions));
    let allowed = match range(key, all, defaults) {
        Some([low, high]) => format!(" ({low}–{high})"),
        None if !names.is_empty() => format!(" ({})", names.join(", ")),
        None => String::new(),
    };
    format!("- {named}{allowed}: {meaning}\n")
}

/// The list of a section, which is a table of the configuration, or its root.
fn list(section: &str, all: &[Key], defaults: &toml::Table, definitions: &Value) -> String {
    let mut text = String::new();
    for key in all {
        let top = key.name.split('.').next().unwrap();
        let belongs = match section {
            "" => top == key.name,
            _ => top == section && top != key.name,
        };
        if belongs {
            text += &item(key, all, section, defaults, definitions);
        }
    }
    text
}

#[test]
fn documented_keys_match_code() {
    let schema = schemars::schema_for!(NodeConfig).to_value();
    let definitions = &schema["$defs"];
    let mut all = Vec::new();
    keys(&schema, definitions, "", &mut all);
    let complete = load_with(&[]).unwrap();
    let defaults: toml::Table = complete.to_toml().unwrap().parse().unwrap();

    let mut page = std::fs::read_to_string(manual()).unwrap();
    let before = page.clone();
    let mut sections: Vec<&str> = all
        .iter()
        .map(|key| key.name.split_once('.').map_or("", |(section, _)| section))
        .collect();
    sections.sort_unstable();
    sections.dedup();
    for section in sections {
        let name = if section.is_empty() { "node" } else { section };
        let begin = format!("<!-- keys of {name}: begin -->\n");
        let end = format!("<!-- keys of {name}: end -->");
        let start = page
            .find(&begin)
            .unwrap_or_else(|| panic!("docs/configuration.md has no line {begin}"))
            + begin.len();
        let length = page[start..].find(&end).unwrap();
        let list = list(section, &all, &defaults, definitions);
        page.replace_range(start..start + length, &list);
    }
    if std::env::var("INSTA_UPDATE").is_ok_and(|value| value == "always") {
        std::fs::write(manual(), &page).unwrap();
    } else {
        assert!(
            page == before,
            "docs/configuration.md is out of date; regenerate with: INSTA_UPDATE=always make snapshots"
        );
    }
}
