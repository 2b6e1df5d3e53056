//! Converts the values read from all sources to a configuration, or to an error message.

use figment::Figment;
use figment::providers::{Env, Serialized};
use figment::value::{Dict, Value};

use super::{LoadError, NodeConfig};

const ENVIRONMENT_PREFIX: &str = "ECOD_";

/// `ECOD_…`, two underscores between the levels of a key. `ECOD_BROKER` is the clients': the
/// address of a node, not the table of the same name.
pub(super) fn environment() -> Env {
    Env::prefixed(ENVIRONMENT_PREFIX)
        .ignore(&["broker"])
        .split("__")
}

/// Reads the configuration. The type of a value from the environment (number, list and so on) is
/// guessed from its text; if a key does not accept the guessed type, the value is used as text.
pub(super) fn extract(mut figment: Figment) -> Result<NodeConfig, LoadError> {
    let mut as_guessed: Option<figment::Error> = None;
    loop {
        let mut errors = match figment.extract() {
            Ok(config) => return Ok(config),
            Err(errors) => errors,
        };
        if let Some(key) = key_in_table(&errors, &figment) {
            errors.path.push(key);
            errors.metadata = figment.find_metadata(&errors.path.join(".")).cloned();
        }
        // Also wrong as text: the first error is reported.
        if let Some(first) = as_guessed.take_if(|first| first.path == errors.path) {
            return Err(LoadError::Malformed(describe(first)));
        }
        match guessed_wrong(&figment, &errors) {
            Some((key, text)) => figment = figment.merge(Serialized::default(&key, text)),
            None => return Err(LoadError::Malformed(describe(errors))),
        }
        as_guessed = Some(errors);
    }
}

/// The key and the text of a value from the environment that was not interpreted as text.
fn guessed_wrong(figment: &Figment, error: &figment::Error) -> Option<(String, String)> {
    let key = error.path.join(".");
    if !from_environment(error) || figment.find_value(&key).ok()?.as_str().is_some() {
        return None;
    }
    let (_, text) = environment().iter().find(|(name, _)| *name == key)?;
    Some((key, text))
}

fn from_environment(error: &figment::Error) -> bool {
    error
        .metadata
        .as_ref()
        .is_some_and(|metadata| metadata.name.contains("environment variable"))
}

/// Keys whose values are never shown.
const SECRETS: [&str; 4] = ["password", "key", "token", "url"];

/// Every error with its key and where it was read, and without any secret.
fn describe(errors: figment::Error) -> String {
    let describe = |error: figment::Error| {
        let key = error.path.join(".");
        let origin = match &error.metadata {
            Some(_) if from_environment(&error) => {
                format!(
                    " in the environment variable {ENVIRONMENT_PREFIX}{}",
                    error.path.join("__").to_uppercase()
                )
            }
            Some(metadata) => {
                let place = metadata
                    .source
                    .as_ref()
                    .map_or_else(String::new, |source| format!(" {source}"));
                format!(" in {}{place}", metadata.name)
            }
            None => String::new(),
        };
        let reason = match &error.kind {
            figment::error::Kind::InvalidType(..) | figment::error::Kind::InvalidValue(..)
                if SECRETS.iter().any(|secret| key.ends_with(secret)) =>
            {
                "must be text in quotes".to_owned()
            }
            figment::error::Kind::Message(text) if text == "invalid socket address syntax" => {
                "must be an IP address and a port, such as 0.0.0.0:1883".to_owned()
            }
            kind => without_secrets(&kind.to_string()),
        };
        // Without a key, the file itself cannot be read as TOML.
        if key.is_empty() {
            format!("configuration{origin}: {reason}")
        } else {
            format!("configuration key `{key}`{origin}: {reason}")
        }
    };
    errors
        .into_iter()
        .map(describe)
        .collect::<Vec<_>>()
        .join("\n")
}

/// The wrong key in a table that is selected by its `kind`: serde reads such a table from a buffer
/// and loses the position. It is the key without which the error changes.
fn key_in_table(error: &figment::Error, figment: &Figment) -> Option<String> {
    if matches!(error.kind, figment::error::Kind::MissingField(_)) {
        return None;
    }
    let keys = figment
        .find_value(&error.path.join("."))
        .ok()?
        .into_dict()
        .filter(|table| table.contains_key("kind"))?;
    let error_without = |key: &String| {
        let mut root: Dict = figment.extract().ok()?;
        let table =
            error
                .path
                .iter()
                .try_fold(&mut root, |table, level| match table.get_mut(level) {
                    Some(Value::Dict(_, table)) => Some(table),
                    _ => None,
                });
        table?.remove(key);
        Figment::from(Serialized::defaults(root))
            .extract::<NodeConfig>()
            .err()
    };
    let is_wrong = |key: &String| error_without(key).is_none_or(|other| other.kind != error.kind);
    keys.into_keys().filter(|key| key != "kind").find(is_wrong)
}

/// Errors in the syntax of TOML quote the affected line.
fn without_secrets(text: &str) -> String {
    let hide = |line: &str, secret: &str| match line.split_once(secret) {
        Some((before, after)) if after.contains('=') => format!("{before}{secret} = ***"),
        _ => line.to_owned(),
    };
    let lines = text.lines().map(|line| {
        SECRETS
            .iter()
            .fold(line.to_owned(), |line, secret| hide(&line, secret))
    });
    lines.collect::<Vec<_>>().join("\n")
}
