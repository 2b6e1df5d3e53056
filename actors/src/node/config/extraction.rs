//! Converts the values read from all sources to a configuration, or to an error message.

use std::sync::LazyLock;

use ecod::logins::without_logins;
use figment::Figment;
use figment::error::Kind;
use figment::providers::{Env, Serialized};
use figment::value::{Dict, Value};

use super::{LoadError, NodeConfig};

const ENVIRONMENT_PREFIX: &str = "ECOD_";

/// `ECOD_…`, two underscores between the levels of a key. Variables of other programs are left out:
/// `ECOD_BROKER` is the clients', the address of a node and not the table of the same name, and
/// container platforms set `ECOD_PORT` and others for a service named `ecod`.
pub(super) fn environment() -> Env {
    Env::prefixed(ENVIRONMENT_PREFIX)
        .ignore(&["broker"])
        .filter(|name| is_of_a_key(name.as_str()))
        .split("__")
}

/// Variables with the prefix of keys that name no key.
pub(crate) fn variables_without_key() -> Vec<String> {
    let names = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    let is_unknown = |name: &String| {
        name.strip_prefix(ENVIRONMENT_PREFIX)
            .is_some_and(|name| name != "BROKER" && !is_of_a_key(name))
    };
    names.filter(is_unknown).collect()
}

/// True if a variable, without its prefix, is of a key or table of the configuration.
fn is_of_a_key(name: &str) -> bool {
    static KEYS: LazyLock<&[&str]> = LazyLock::new(|| {
        // Only serde has the list of keys that are not set.
        let unknown = Figment::from(Serialized::default("no such key", true));
        match unknown.extract::<NodeConfig>().map_err(|error| error.kind) {
            Err(Kind::UnknownField(_, keys)) => keys,
            _ => &[],
        }
    });
    let first = name.split("__").next().unwrap_or(name);
    KEYS.iter().any(|key| key.eq_ignore_ascii_case(first))
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
        // Also wrong as text: the first error is reported, unless the key takes other texts.
        if let Some(first) = as_guessed.take_if(|first| first.path == errors.path) {
            let takes_text =
                matches!(&first.kind, Kind::InvalidType(_, expected) if expected == "a string");
            errors.metadata.clone_from(&first.metadata);
            let reported = if takes_text { errors } else { first };
            return Err(LoadError::Malformed(describe(reported)));
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

/// Keys whose values are hidden.
const SECRETS: [&str; 5] = ["password", "key", "token", "url", "pipeline"];

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
            Kind::InvalidType(..) | Kind::InvalidValue(..)
                if SECRETS.iter().any(|secret| key.ends_with(secret)) =>
            {
                "must be text in quotes".to_owned()
            }
            Kind::Message(text) if text == "invalid socket address syntax" => {
                "must be an IP address and a port, such as 0.0.0.0:1883".to_owned()
            }
            Kind::UnknownField(key, keys) => unknown_key(key, keys),
            Kind::UnknownVariant(found, known) => format!(
                "`{}` is not allowed, must be one of `{}`",
                without_secrets(found),
                known.join("`, `")
            ),
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

/// Similarity from which a key is suggested in place of an unknown one.
const SIMILAR: f64 = 0.75;

/// The error of a key that does not exist: the most similar key, or else all keys.
fn unknown_key(unknown: &str, keys: &[&str]) -> String {
    let similarity = |key: &&str| strsim::jaro(unknown, key);
    let similar = keys
        .iter()
        .copied()
        .max_by(|one, other| similarity(one).total_cmp(&similarity(other)))
        .filter(|key| similarity(key) >= SIMILAR);
    match similar {
        Some(key) => format!("unknown key; did you mean `{key}`?"),
        None => format!("unknown key; the keys here are `{}`", keys.join("`, `")),
    }
}

/// The wrong key in a table that is selected by its `kind`: serde reads such a table from a buffer
/// and loses the position. It is the key without which the error changes.
fn key_in_table(error: &figment::Error, figment: &Figment) -> Option<String> {
    if matches!(error.kind, Kind::MissingField(_)) {
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
    without_logins(&lines.collect::<Vec<_>>().join("\n"))
}
