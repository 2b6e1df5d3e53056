//! Sections of the configuration: defaults, allowed ranges, and errors that name key, value and
//! range.

use std::fmt::Display;

use crate::logins::without_logins;

/// A configuration value that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("configuration key `{key}`{fault}, must be {allowed}")]
pub struct ConfigError {
    /// Full key, such as `pace.gate_m`.
    pub key: String,
    /// Why the value cannot be used.
    pub fault: ValueFault,
    /// The allowed values as a phrase, such as `a number from 0.1 to 100`.
    pub allowed: String,
}

/// Why a configuration value cannot be used. Its text follows the key in an error message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValueFault {
    /// The value found, as text.
    #[error(": {0} is not allowed")]
    NotAllowed(String),
    /// The key has no value.
    #[error(" is missing")]
    Missing,
    /// The text is too short. Errors do not show it, because it may be a secret.
    #[error(" is too short")]
    TooShort,
    /// The IP address is 0.0.0.0 or `::`, or the port is 0.
    #[error(" is unspecified")]
    Unspecified,
}

impl ConfigError {
    /// An error about one key with the value found, which is shown without a login.
    pub fn new(key: impl Into<String>, value: impl Display, allowed: impl Into<String>) -> Self {
        let shown = without_logins(&value.to_string());
        Self::with_fault(key, ValueFault::NotAllowed(shown), allowed)
    }

    /// An error about one key without a value.
    pub fn missing(key: impl Into<String>, allowed: impl Into<String>) -> Self {
        Self::with_fault(key, ValueFault::Missing, allowed)
    }

    /// An error about one key with a fault of its value.
    pub fn with_fault(
        key: impl Into<String>,
        fault: ValueFault,
        allowed: impl Into<String>,
    ) -> Self {
        Self {
            key: key.into(),
            fault,
            allowed: allowed.into(),
        }
    }

    /// The same error with the key prefixed by `section`; an error without a key gets the section
    /// as its key.
    #[must_use]
    pub fn within(mut self, section: &str) -> Self {
        self.key = if self.key.is_empty() {
            section.into()
        } else {
            format!("{section}.{}", self.key)
        };
        self
    }
}

/// Defines a section of the configuration: the default of each field and its check, if any, stand
/// next to its documentation. A check is a range, which may name other fields, or a function.
///
/// Generates the struct, its `Default` and `validate`.
macro_rules! config_section {
    ($(#[$attribute:meta])* pub struct $name:ident {
        $($(#[$doc:meta])* pub $field:ident: $type:ty = $default:expr
            $(, in $low:tt to $high:expr)? $(, checked by $check:expr)?;)*
    }) => {
        $(#[$attribute])*
        #[derive(
            Debug,
            Clone,
            PartialEq,
            serde::Serialize,
            serde::Deserialize,
            schemars::JsonSchema,
        )]
        #[serde(default, deny_unknown_fields)]
        pub struct $name {
            $($(#[$doc])* pub $field: $type,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }

        impl $name {
            /// Checks all values.
            ///
            /// # Errors
            /// Returns a [`ConfigError`](crate::config::ConfigError) that names the first key out
            /// of range.
            pub fn validate(&self) -> Result<(), crate::config::ConfigError> {
                #[allow(unused_variables)]
                let Self { $($field,)* } = self;
                $($(crate::config::check_range(stringify!($field), *$field as f64, $low, $high)?;)?)*
                $($($check($field).map_err(|error| error.within(stringify!($field)))?;)?)*
                Ok(())
            }
        }
    };
}
pub(crate) use config_section;

/// Checks that `value` is a number from `low` to `high`.
///
/// # Errors
/// Returns a [`ConfigError`] otherwise, also for NaN.
pub fn check_range(key: &str, value: f64, low: f64, high: f64) -> Result<(), ConfigError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        let shown = if value.abs() < 1e9 {
            value.to_string()
        } else {
            format!("{value:e}")
        };
        Err(ConfigError::new(
            key,
            shown,
            format!("a number from {low} to {high}"),
        ))
    }
}

/// A check that a value, if there is one, is a number from `low` to `high`.
pub(crate) fn check_optional(
    low: f64,
    high: f64,
) -> impl Fn(&Option<f64>) -> Result<(), ConfigError> {
    move |value| value.map_or(Ok(()), |value| check_range("", value, low, high))
}
