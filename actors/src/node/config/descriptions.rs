//! Descriptions of the configuration's keys, from the documentation of their fields.

use serde_json::Value as Schema;
use toml::{Table, Value};

use super::NodeConfig;

/// Descriptions of all keys.
pub(super) struct KeyDescriptions {
    schema: Schema,
}

/// Descriptions of the keys of one table.
pub(super) struct TableDescriptions<'a> {
    definitions: &'a Schema,
    /// Schemas whose `properties` or `additionalProperties` are keys of the table.
    schemas: Vec<&'a Schema>,
}

impl KeyDescriptions {
    pub(super) fn new() -> Self {
        Self {
            schema: schemars::schema_for!(NodeConfig).to_value(),
        }
    }

    /// Descriptions of the keys of the whole configuration.
    pub(super) fn root<'a>(&'a self, table: &Table) -> TableDescriptions<'a> {
        TableDescriptions::new(&self.schema, &self.schema["$defs"], table)
    }
}

impl<'a> TableDescriptions<'a> {
    fn new(schema: &'a Schema, definitions: &'a Schema, table: &Table) -> Self {
        let mut schemas = Vec::new();
        collect(schema, definitions, table, &mut schemas);
        Self {
            definitions,
            schemas,
        }
    }

    /// The first sentence about a key; `None` if its field has no documentation. A key that selects
    /// a kind, such as `kind`, has the description of the kind.
    pub(super) fn of(&self, key: &str) -> Option<String> {
        let (table, field) = self.find(key)?;
        let is_kind = field.get("const").is_some();
        let described = if is_kind { table } else { field };
        let text = described["description"].as_str().or_else(|| {
            let target = &self.definitions[referenced(field)?];
            target["description"].as_str()
        })?;
        sentences(&text.replace('\n', " ")).into_iter().next()
    }

    /// Descriptions of the keys of a table below this one.
    pub(super) fn within(&self, key: &str, table: &Table) -> Self {
        let field = self.find(key).map_or(&Schema::Null, |(_, field)| field);
        let items = field.get("items").unwrap_or(field);
        Self::new(items, self.definitions, table)
    }

    /// The schema of a key, and the schema of which it is a property.
    fn find(&self, key: &str) -> Option<(&'a Schema, &'a Schema)> {
        let named = |schema: &&'a Schema| Some((*schema, schema["properties"].get(key)?));
        let any = |schema: &&'a Schema| {
            let further = schema.get("additionalProperties")?;
            further.is_object().then_some((*schema, further))
        };
        let mut schemas = self.schemas.iter();
        schemas
            .find_map(named)
            .or_else(|| self.schemas.iter().find_map(any))
    }
}

/// Adds the schemas of a table's keys: of the schema itself, of the schema to which it refers, and of
/// the alternative that the table chooses.
fn collect<'a>(
    schema: &'a Schema,
    definitions: &'a Schema,
    table: &Table,
    found: &mut Vec<&'a Schema>,
) {
    if schema.get("properties").is_some() || schema.get("additionalProperties").is_some() {
        found.push(schema);
    }
    if let Some(target) = referenced(schema) {
        collect(&definitions[target], definitions, table, found);
    }
    for combination in ["anyOf", "oneOf", "allOf"] {
        let parts = schema[combination].as_array().into_iter().flatten();
        for part in parts.filter(|part| is_chosen(part, table)) {
            collect(part, definitions, table, found);
        }
    }
}

/// Name of the definition to which a schema refers.
fn referenced(schema: &Schema) -> Option<&str> {
    schema["$ref"].as_str()?.rsplit('/').next()
}

/// False if the table's keys contradict the constants of an alternative.
fn is_chosen(alternative: &Schema, table: &Table) -> bool {
    let constants = alternative["properties"].as_object();
    constants.into_iter().flatten().all(|(key, field)| {
        let constant = field.get("const").and_then(Schema::as_str);
        constant.is_none_or(|constant| table.get(key).and_then(Value::as_str) == Some(constant))
    })
}

/// The sentences of a text. They end with a full stop before a space and a capital letter or a code
/// span.
pub fn sentences(text: &str) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for part in text.split(". ") {
        let mut letters = part.chars();
        let begins = letters
            .next()
            .is_some_and(|letter| letter.is_uppercase() || letter == '`');
        match found.last_mut() {
            Some(before) if !begins => {
                before.push_str(". ");
                before.push_str(part);
            }
            Some(before) => {
                before.push('.');
                found.push(part.to_owned());
            }
            None => found.push(part.to_owned()),
        }
    }
    found
}
