//! The configuration as text that can be read back.

use figment::Figment;
use figment::providers::Serialized;
use toml::{Table, Value};

use super::NodeConfig;
use super::descriptions::{KeyDescriptions, TableDescriptions};

impl NodeConfig {
    /// The configuration as TOML that can be read back. Secrets are left out, and a comment marks
    /// each.
    ///
    /// # Errors
    /// Returns an error if a value has no form in TOML.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let (shown, comment) = self.without_secrets();
        Ok(comment + &toml::to_string(&shown)?)
    }

    /// The configuration as TOML, reduced to keys whose values differ from the defaults.
    ///
    /// # Errors
    /// Returns an error if a value has no form in TOML.
    pub fn to_toml_changed(&self) -> Result<String, toml::ser::Error> {
        let (keys, comment) = self.changed_keys()?;
        Ok(comment + &toml::to_string(&keys)?)
    }

    /// The configuration as [`Self::to_toml_changed`] writes it, with a comment of one line on each
    /// key.
    ///
    /// # Errors
    /// Returns an error if a value has no form in TOML.
    pub fn to_toml_commented(&self) -> Result<String, toml::ser::Error> {
        let (keys, comment) = self.changed_keys()?;
        let descriptions = KeyDescriptions::new();
        let mut text = comment;
        write_table(&mut text, "", &keys, &descriptions.root(&keys))?;
        Ok(text)
    }

    /// The keys whose values differ from the defaults, and a comment on missing secrets.
    fn changed_keys(&self) -> Result<(Table, String), toml::ser::Error> {
        let (shown, comment) = self.without_secrets();
        let mut keys = Table::try_from(&shown)?;
        remove_defaults(&mut keys, &mut Vec::new(), &shown);
        Ok((keys, comment))
    }

    /// The configuration without secrets, and a comment on each that is missing.
    fn without_secrets(&self) -> (Self, String) {
        let mut shown = self.clone();
        let mut comment = String::new();
        if shown.mqtt.password.take().is_some() {
            comment.push_str(
                "# `mqtt.password` is set but not shown: add it, or set ECOD_MQTT__PASSWORD\n",
            );
        }
        if shown.uplink.password.take().is_some() {
            comment.push_str(
                "# `uplink.password` is set but not shown: add it, or set ECOD_UPLINK__PASSWORD\n",
            );
        }
        if shown.dashboard.token.take().is_some() {
            comment.push_str(
                "# `dashboard.token` is set but not shown: add it, or set ECOD_DASHBOARD__TOKEN\n",
            );
        }
        if shown.membership.key.take().is_some() {
            comment.push_str(
                "# `membership.key` is set but not shown: add it, or set ECOD_MEMBERSHIP__KEY\n",
            );
        }
        #[cfg(feature = "camera")]
        for camera in shown.camera.iter_mut().chain(&mut shown.cameras) {
            if let Some(key) = camera.source.remove_credentials() {
                let of = camera
                    .name
                    .as_ref()
                    .map_or_else(String::new, |name| format!(" of camera {name}"));
                let line = format!(
                    "# user and password of `camera.source.{key}`{of} are set but not shown: add them\n"
                );
                comment.push_str(&line);
            }
        }
        (shown, comment)
    }
}

/// Writes the keys of a table, each below its description, and then the tables in it. `path` is the
/// table's name, empty for the root.
fn write_table(
    text: &mut String,
    path: &str,
    table: &Table,
    descriptions: &TableDescriptions<'_>,
) -> Result<(), toml::ser::Error> {
    let comment = |text: &mut String, key: &str| {
        if let Some(sentence) = descriptions.of(key) {
            *text += &format!("# {sentence}\n");
        }
    };
    for (key, value) in table {
        if tables_of(value).is_none() {
            comment(text, key);
            *text += &toml::to_string(&Table::from_iter([(key.clone(), value.clone())]))?;
        }
    }
    for (key, value) in table {
        let name = toml::to_string(&Table::from_iter([(key.clone(), true.into())]))?;
        let name = name.trim_end().trim_end_matches("= true").trim_end();
        let path = match path {
            "" => name.to_owned(),
            above => format!("{above}.{name}"),
        };
        for inner in tables_of(value).into_iter().flatten() {
            let is_only_above = !inner.is_empty() && inner.values().all(Value::is_table);
            if value.is_array() || !is_only_above {
                text.push('\n');
                comment(text, key);
                *text += &match value {
                    Value::Array(_) => format!("[[{path}]]\n"),
                    _ => format!("[{path}]\n"),
                };
            }
            write_table(text, &path, inner, &descriptions.within(key, inner))?;
        }
    }
    Ok(())
}

/// The table of a value, or the tables of an array of tables; `None` for other values.
fn tables_of(value: &Value) -> Option<Vec<&Table>> {
    match value {
        Value::Table(table) => Some(vec![table]),
        Value::Array(values) if !values.is_empty() => values.iter().map(Value::as_table).collect(),
        _ => None,
    }
}

/// Removes each key and table below `path` without which the configuration is still `config`.
fn remove_defaults(keys: &mut Table, path: &mut Vec<String>, config: &NodeConfig) {
    let names: Vec<String> = at(keys, path)
        .into_iter()
        .flat_map(|table| table.keys().cloned())
        .collect();
    for name in names {
        let Some(value) = at(keys, path).and_then(|table| table.remove(&name)) else {
            continue;
        };
        let rest = Figment::from(Serialized::defaults(&*keys));
        if NodeConfig::of_keys(&rest).is_ok_and(|rest| rest == *config) {
            continue;
        }
        let is_table = value.is_table();
        if let Some(table) = at(keys, path) {
            table.insert(name.clone(), value);
        }
        if is_table {
            path.push(name);
            remove_defaults(keys, path, config);
            path.pop();
        }
    }
}

/// The table at a path of tables.
fn at<'a>(keys: &'a mut Table, path: &[String]) -> Option<&'a mut Table> {
    path.iter().try_fold(keys, |table, name| {
        table.get_mut(name).and_then(Value::as_table_mut)
    })
}
