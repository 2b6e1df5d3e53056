//! Troubles that a node has or observes.

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A current trouble, with cause and remedy as text for people.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Trouble {
    /// Stable name of its kind, such as `clock_off`. Later versions may have further kinds.
    #[n(0)]
    pub kind: String,
    /// The vehicle, address or host that it is about; absent if it is about the node itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(1)]
    pub about: Option<String>,
    /// The cause, with its figures.
    #[n(2)]
    pub cause: String,
    /// The remedy as text.
    #[n(3)]
    pub remedy: String,
}

/// Maximum number of troubles in a status.
pub const MAX_TROUBLES: usize = 16;

/// Maximum number of dismissed nodes in a status.
pub const MAX_DISMISSED: usize = 16;

/// Maximum length of a cause or remedy in bytes.
pub const MAX_TROUBLE_TEXT: usize = 300;
