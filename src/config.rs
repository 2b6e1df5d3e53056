//! Sections of the configuration: defaults, allowed ranges, and errors that name key, value and
//! range.

use std::fmt::Display;

/// A configuration value that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("configuration key `{key}`: {value} is not allowed, must be {allowed}")]
pub struct ConfigError {
    /// Full key, such as `pace.gate_m`.
    pub key: String,
    /// The value found, as text.
    pub value: String,
    /// The allowed values as a phrase, such as `a number from 0.1 to 100`.
    pub allowed: String,
}

impl ConfigError {
    /// An error about one key.
    pub fn new(key: impl Into<String>, value: impl Display, allowed: impl Into<String>) -> Self {
        Self {
            key: key.into(),
            value: value.to_string(),
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
