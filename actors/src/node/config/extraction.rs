//! From what was read of all sources to a configuration, or to words about what is wrong with it.

use figment::Figment;
use figment::providers::{Env, Serialized};
use figment::value::{Dict, Value};

use super::{LoadError, NodeConfig};

const ENVIRONMENT_PREFIX: &str = "ECOD_";

/// `ECOD_…`, two underscores between the levels of a key. `ECOD_BROKER` is the clients': the address of a node, not
/// the table of the same name.
pub(super) fn environment() -> Env {
    Env::prefixed(ENVIRONMENT_PREFIX)
        .ignore(&["broker"])
        .split("__")
}

/// Reads the configuration. Values from the environment are guessed to be numbers, lists and so on by their looks;
/// where a key does not want what was guessed, the value is taken as the text that it is.
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
        // Wrong as text too: the first error is the one to tell of.
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

/// The key and the text of a value from the environment that was taken for something else than text.
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

/// Keys whose values are shown to nobody.
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

/// The key that is wrong in a table that its `kind` tells apart: serde reads such a table from a buffer and forgets
/// where it was. It is the one without which the error is another.
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

/// Errors in the syntax of TOML quote the line that they are about.
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
