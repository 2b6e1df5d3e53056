//! JSON Schemas in the form that Foxglove and Lichtblick read.
//!
//! They drop a channel whose schema has a field that they do not understand. A field needs one
//! `type`, an array needs `items`, alternatives are named numbers, and references are not followed.
//! Optional fields are `nullable`, as in OpenAPI 3.0. Alternatives below `anyOf` are ignored.

use schemars::generate::SchemaSettings;
use schemars::transform::transform_subschemas;
use schemars::{JsonSchema, Schema};
use serde_json::{Map, Value, json};

/// Schema of a channel with these messages.
pub(crate) fn schema_of<T: JsonSchema>() -> Schema {
    let settings = SchemaSettings::default().with(|settings| {
        settings.meta_schema = None;
        settings.inline_subschemas = true;
    });
    settings
        .with_transform(simplify)
        .into_generator()
        .into_root_schema_for::<T>()
}

fn simplify(schema: &mut Schema) {
    transform_subschemas(&mut simplify, schema);
    let Some(schema) = schema.as_object_mut() else {
        return;
    };
    for key in ["anyOf", "oneOf"] {
        if let Some(Value::Array(alternatives)) = schema.remove(key) {
            merge_alternatives(schema, alternatives);
        }
    }
    if let Some(Value::Array(types)) = schema.get_mut("type") {
        let (null, mut rest): (Vec<_>, Vec<_>) = types.drain(..).partition(|name| name == "null");
        let single = if rest.len() == 1 {
            rest.remove(0)
        } else {
            rest.into()
        };
        schema.insert("type".into(), single);
        if !null.is_empty() {
            schema.insert("nullable".into(), true.into());
        }
    }
    let is_always_empty = schema.get("maxItems").is_some_and(|most| most == 0);
    if is_always_empty && !schema.contains_key("items") {
        schema.insert("items".into(), json!({ "type": "object" }));
    }
}

/// Reduces the alternatives of a field to their common part.
fn merge_alternatives(schema: &mut Map<String, Value>, mut alternatives: Vec<Value>) {
    if alternatives
        .iter()
        .all(|alternative| alternative["const"].is_number())
    {
        schema.insert("oneOf".into(), alternatives.into());
        return;
    }
    let all = alternatives.len();
    alternatives.retain(|alternative| alternative["type"] != "null");
    if alternatives.len() < all {
        schema.insert("nullable".into(), true.into());
    }
    if let [Value::Object(only)] = &mut *alternatives {
        for (key, value) in std::mem::take(only) {
            schema.entry(key).or_insert(value);
        }
        return;
    }
    if let Some(common) = alternatives.first().map(|first| first["type"].clone())
        && common.is_string()
        && alternatives
            .iter()
            .all(|alternative| alternative["type"] == common)
    {
        schema.insert("type".into(), common);
    }
    schema.insert("anyOf".into(), alternatives.into());
}

#[cfg(test)]
mod tests {
    use super::super::SchemaName;
    use super::*;

    /// Fails if viewers would leave out the channel.
    fn check(path: &str, schema: &Value) {
        assert_eq!(schema["type"], "object", "{path}");
        for (name, field) in schema["properties"].as_object().into_iter().flatten() {
            let path = format!("{path}.{name}");
            if let Some(alternatives) = field["oneOf"].as_array() {
                assert!(
                    alternatives
                        .iter()
                        .all(|alternative| alternative["const"].is_number()),
                    "{path}: {field}"
                );
                continue;
            }
            match field["type"].as_str() {
                Some("object") => check(&path, field),
                Some("array") if field["items"]["type"] == "object" => {
                    check(&path, &field["items"]);
                }
                Some("array") => assert!(is_plain(&field["items"]), "{path}: {field}"),
                _ => assert!(is_plain(field), "{path}: {field}"),
            }
        }
    }

    fn is_plain(field: &Value) -> bool {
        field["type"]
            .as_str()
            .is_some_and(|name| ["boolean", "string", "number", "integer"].contains(&name))
    }

    #[test]
    fn every_channel_schema_is_readable() {
        for schema in SchemaName::ALL {
            let json = schema.json_schema().to_value();
            check(schema.as_str(), &json);
            let text = json.to_string();
            for reference in ["\"$ref\"", "\"$defs\""] {
                assert!(!text.contains(reference), "{reference} in {text}");
            }
        }
    }

    #[test]
    fn schema_states_encoding_and_levels() {
        let image = SchemaName::CompressedImage.json_schema().to_value();
        assert_eq!(image["properties"]["data"]["contentEncoding"], "base64");
        let log = SchemaName::Log.json_schema().to_value();
        let levels = log["properties"]["level"]["oneOf"].as_array().unwrap();
        let named = |name: &str, level: u8| {
            levels
                .iter()
                .any(|one| one["title"] == name && one["const"] == level)
        };
        assert!(named("INFO", 2) && named("WARNING", 3), "{levels:?}");
    }

    #[test]
    fn nullable_fields_are_declared() {
        let report = SchemaName::ObjectReport.json_schema().to_value();
        let pose = &report["properties"]["pose"];
        assert_eq!(
            (&pose["type"], &pose["nullable"]),
            (&json!("object"), &json!(true)),
            "{pose}"
        );
        assert_eq!(pose["properties"]["x_m"]["type"], "number");
        assert!(report["properties"]["seq"].get("nullable").is_none());
    }
}
