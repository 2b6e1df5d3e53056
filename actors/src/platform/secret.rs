//! Secrets in the configuration.

use std::fmt;

use ecod::logins::HIDDEN;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A secret text. It appears in no log and no printed configuration.
#[derive(Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(try_from = "String")]
pub struct Secret(String);

/// A placeholder that was given as the secret itself.
#[derive(Debug, thiserror::Error)]
#[error("`{HIDDEN}` stands for a secret that was not printed, give the secret itself")]
pub struct HiddenSecret;

impl TryFrom<String> for Secret {
    type Error = HiddenSecret;

    fn try_from(text: String) -> Result<Self, HiddenSecret> {
        if text == HIDDEN {
            Err(HiddenSecret)
        } else {
            Ok(Self(text))
        }
    }
}

impl Secret {
    /// A secret of a text.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// The text of the secret, which must not be logged.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl Serialize for Secret {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(HIDDEN)
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(HIDDEN)
    }
}
