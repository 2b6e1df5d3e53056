//! The description of a cell: the settings that all its nodes share.

use std::fmt;
use std::str::FromStr;

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::model::names::NodeName;

/// SHA-256 of a description's content. As text: 64 hexadecimal digits.
#[derive(
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Default,
    Serialize,
    Deserialize,
    Encode,
    Decode,
    JsonSchema,
)]
#[serde(try_from = "String", into = "String")]
#[cbor(transparent)]
#[schemars(with = "String", extend("pattern" = "^[0-9a-f]{64}$"))]
pub struct ContentHash(#[cbor(n(0), with = "minicbor::bytes")] pub [u8; 32]);

/// Error for a text that is not a [`ContentHash`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a hash has 64 hexadecimal digits")]
pub struct InvalidHash;

impl ContentHash {
    /// The first eight digits, for people.
    pub fn short(&self) -> String {
        self.0
            .iter()
            .take(4)
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for ContentHash {
    type Err = InvalidHash;

    fn from_str(text: &str) -> Result<Self, InvalidHash> {
        let digit = |byte: u8| char::from(byte).to_digit(16).ok_or(InvalidHash);
        let bytes = text
            .as_bytes()
            .chunks(2)
            .map(|pair| match *pair {
                [high, low] => Ok((digit(high)? << 4 | digit(low)?) as u8),
                _ => Err(InvalidHash),
            })
            .collect::<Result<Vec<u8>, _>>()?;
        Ok(Self(bytes.try_into().map_err(|_| InvalidHash)?))
    }
}

impl TryFrom<String> for ContentHash {
    type Error = InvalidHash;

    fn try_from(text: String) -> Result<Self, InvalidHash> {
        text.parse()
    }
}

impl From<ContentHash> for String {
    fn from(hash: ContentHash) -> Self {
        hash.to_string()
    }
}

/// Version and hash of a description. The later version wins; between equal versions, the greater
/// hash.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Default,
    Serialize,
    Deserialize,
    Encode,
    Decode,
    JsonSchema,
)]
pub struct DescriptionStamp {
    /// Increases by one with every change; 0 without a description.
    #[n(0)]
    pub version: u64,
    /// Hash of the content.
    #[n(1)]
    pub hash: ContentHash,
}

impl fmt::Display for DescriptionStamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.version, self.hash.short())
    }
}

/// The settings that all nodes of a cell share. Retained.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct CellDescription {
    /// Major version of the payload, [`SCHEMA_VERSION`](crate::wire::SCHEMA_VERSION).
    #[n(0)]
    pub schema: u32,
    /// Increases by one with every change. In a program's request to its node: 0.
    #[n(1)]
    pub version: u64,
    /// SHA-256 of `set_by`, a line feed and `text`.
    #[n(2)]
    pub hash: ContentHash,
    /// The node at which the description was set, according to that node.
    #[n(3)]
    pub set_by: NodeName,
    /// The settings, as TOML.
    #[n(4)]
    pub text: String,
}

impl CellDescription {
    /// Version and hash, by which nodes compare descriptions.
    pub fn stamp(&self) -> DescriptionStamp {
        DescriptionStamp {
            version: self.version,
            hash: self.hash,
        }
    }

    /// The bytes whose SHA-256 is [`Self::hash`].
    pub fn content(set_by: &NodeName, text: &str) -> Vec<u8> {
        [set_by.as_str(), "\n", text].concat().into_bytes()
    }
}

/// A node's description of its cell, in its status.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct DescriptionStatus {
    /// Version of the description.
    #[n(0)]
    pub version: u64,
    /// Its hash.
    #[n(1)]
    pub hash: ContentHash,
    /// The reason why the node does not use it; absent if it does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(2)]
    pub problem: Option<String>,
}

impl DescriptionStatus {
    /// Version and hash of the description that the node has.
    pub fn stamp(&self) -> DescriptionStamp {
        DescriptionStamp {
            version: self.version,
            hash: self.hash,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_round_trips_and_others_fail() {
        let hash = ContentHash(std::array::from_fn(|byte| byte as u8 * 7));
        assert_eq!(hash.to_string().parse(), Ok(hash));
        for wrong in [
            "",
            "0",
            &"0".repeat(63),
            &"0".repeat(66),
            &"g".repeat(64),
            &"é".repeat(32),
        ] {
            assert_eq!(wrong.parse::<ContentHash>(), Err(InvalidHash), "{wrong}");
        }
    }
}
