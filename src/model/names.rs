//! Names that travel in topics and payloads.

use std::borrow::{Borrow, Cow};
use std::convert::Infallible;
use std::fmt;
use std::ops::Deref;
use std::str::FromStr;

use icu_normalizer::ComposingNormalizerBorrowed;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::{Deserialize, Serialize};
use smol_str::SmolStr;

/// Longest accepted name, label or landmark id in bytes.
pub const MAX_NAME_BYTES: usize = 64;

/// Separator between a node's name and the name of its part, such as a program that runs with it.
pub const PART_MARK: &str = "--";

/// A name that is not made of 1 to 64 of the characters `A-Z a-z 0-9 _ -`.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("name {0:?} must be 1 to 64 characters of A-Z, a-z, 0-9, _ and -")]
pub struct InvalidName(pub String);

/// A node's or cell's name: a single MQTT topic level of `[A-Za-z0-9_-]{1,64}`. Cheap to clone.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "SmolStr", into = "SmolStr")]
#[schemars(extend("pattern" = "^[A-Za-z0-9_-]{1,64}$"))]
pub struct NodeName(SmolStr);

impl NodeName {
    /// Checks and takes a name.
    ///
    /// # Errors
    /// Returns an [`InvalidName`] if a character or the length is not allowed.
    pub fn new(name: impl AsRef<str>) -> Result<Self, InvalidName> {
        Self::try_from(SmolStr::new(name))
    }

    /// Creates a name at compile time.
    ///
    /// # Panics
    /// Panics if the name is not allowed.
    pub const fn from_static(name: &'static str) -> Self {
        let bytes = name.as_bytes();
        assert!(
            !bytes.is_empty() && bytes.len() <= MAX_NAME_BYTES,
            "a name has 1 to 64 bytes"
        );
        let mut at = 0;
        while at < bytes.len() {
            assert!(
                is_allowed(bytes[at]),
                "a name has only A-Z, a-z, 0-9, _ and -"
            );
            at += 1;
        }
        Self(SmolStr::new_static(name))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// True if the name belongs to a part of a node, such as a program or an observer beside it.
    pub fn is_part(&self) -> bool {
        vehicle_of(&self.0).len() != self.0.len()
    }

    /// The node that this name belongs to: `euclid` for its part `euclid--lidar`, otherwise the
    /// name itself.
    #[must_use]
    pub fn vehicle(&self) -> Self {
        if self.is_part() {
            Self(SmolStr::new(vehicle_of(&self.0)))
        } else {
            self.clone()
        }
    }
}

/// As [`NodeName::vehicle`], for a text that may be another kind of name, such as an address.
pub fn vehicle_of(name: &str) -> &str {
    // Names are short, and the search for a text would prepare tables for a long one.
    let mut pairs = name.as_bytes().windows(PART_MARK.len());
    match pairs.position(|pair| pair == PART_MARK.as_bytes()) {
        Some(end) if end > 0 => name.get(..end).unwrap_or(name),
        _ => name,
    }
}

const fn is_allowed(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-'
}

impl TryFrom<SmolStr> for NodeName {
    type Error = InvalidName;

    fn try_from(name: SmolStr) -> Result<Self, InvalidName> {
        if (1..=MAX_NAME_BYTES).contains(&name.len()) && name.bytes().all(is_allowed) {
            Ok(Self(name))
        } else {
            Err(InvalidName(name.chars().take(MAX_NAME_BYTES).collect()))
        }
    }
}

impl From<NodeName> for SmolStr {
    fn from(name: NodeName) -> Self {
        name.0
    }
}

impl FromStr for NodeName {
    type Err = InvalidName;

    fn from_str(name: &str) -> Result<Self, InvalidName> {
        Self::new(name)
    }
}

impl fmt::Display for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

/// A class label or decoded text, such as `car` or `ABCD123`, in Unicode's form NFKC: `é` as one or
/// two characters, and letters of full or half width, are equal (Unicode Standard Annex 15). Cheap
/// to clone.
#[derive(Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(from = "SmolStr", into = "SmolStr")]
pub struct Label(SmolStr);

/// The id of a landmark, such as `slot-0`, in the same form as labels.
pub type LandmarkId = Label;

impl Label {
    /// A label of this text.
    pub fn new(text: impl AsRef<str>) -> Self {
        Self::from(text.as_ref())
    }

    /// A label of a text in ASCII.
    ///
    /// # Panics
    /// Panics if the text has other characters.
    pub const fn new_static(text: &'static str) -> Self {
        assert!(text.is_ascii(), "form NFKC is not checked");
        Self(SmolStr::new_static(text))
    }

    /// The label as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<SmolStr> for Label {
    fn from(text: SmolStr) -> Self {
        // A text that is much too long for a label stays as it is; the composed form could be longer.
        if text.is_ascii() || text.len() > 16 * MAX_NAME_BYTES {
            return Self(text);
        }
        let form = ComposingNormalizerBorrowed::new_nfkc();
        Self(form.normalize(&text).into())
    }
}

impl From<&str> for Label {
    fn from(text: &str) -> Self {
        SmolStr::new(text).into()
    }
}

impl From<String> for Label {
    fn from(text: String) -> Self {
        SmolStr::new(text).into()
    }
}

impl From<&String> for Label {
    fn from(text: &String) -> Self {
        SmolStr::new(text).into()
    }
}

impl From<Label> for SmolStr {
    fn from(label: Label) -> Self {
        label.0
    }
}

impl FromStr for Label {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(text.into())
    }
}

impl Deref for Label {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl Borrow<str> for Label {
    fn borrow(&self) -> &str {
        &self.0
    }
}

impl AsRef<str> for Label {
    fn as_ref(&self) -> &str {
        &self.0
    }
}

impl PartialEq<str> for Label {
    fn eq(&self, other: &str) -> bool {
        self.0 == *other
    }
}

impl PartialEq<&str> for Label {
    fn eq(&self, other: &&str) -> bool {
        self.0 == **other
    }
}

impl PartialEq<Label> for &str {
    fn eq(&self, other: &Label) -> bool {
        **self == *other.0
    }
}

impl PartialEq<Label> for str {
    fn eq(&self, other: &Label) -> bool {
        *self == *other.0
    }
}

impl PartialEq<String> for Label {
    fn eq(&self, other: &String) -> bool {
        *self.0 == **other
    }
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl fmt::Debug for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.0, f)
    }
}

impl JsonSchema for Label {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        SmolStr::schema_name()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        SmolStr::json_schema(generator)
    }
}

/// True if a text can be a label or the name of a location: 1 to [`MAX_NAME_BYTES`] bytes without
/// control characters.
pub fn is_label(text: &str) -> bool {
    (1..=MAX_NAME_BYTES).contains(&text.len()) && is_plain_text(text)
}

/// True if a text has no control characters.
pub fn is_plain_text(text: &str) -> bool {
    let is_printable_ascii = text.bytes().all(|byte| (b' '..=b'~').contains(&byte));
    is_printable_ascii || !text.chars().any(|c| c.is_control() || is_layout_control(c))
}

/// A text that satisfies [`is_plain_text`], of at most `max_bytes` bytes: control characters become
/// spaces.
pub fn plain_text(text: &str, max_bytes: usize) -> String {
    let plain = |c: char| {
        if c.is_control() || is_layout_control(c) {
            ' '
        } else {
            c
        }
    };
    let mut kept = String::new();
    for c in text.chars().map(plain) {
        if kept.len() + c.len_utf8() > max_bytes {
            break;
        }
        kept.push(c);
    }
    kept
}

/// True if a character breaks lines or changes the direction of the surrounding text. A label with
/// such a character could make other text on a page or terminal appear as something else (Unicode
/// Technical Report 36, section 2.7).
fn is_layout_control(c: char) -> bool {
    matches!(c, '\u{61C}' | '\u{200E}' | '\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_single_topic_levels() {
        for good in ["euclid", "A-1_b", &"x".repeat(64)] {
            assert!(NodeName::new(good).is_ok(), "{good}");
        }
        for bad in ["", "a/b", "a+", "#", "a b", "é", &"x".repeat(65)] {
            assert!(NodeName::new(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn label_forms_are_equal() {
        let cafe = Label::from("caf\u{e9}");
        assert_eq!(Label::from("cafe\u{301}"), cafe);
        assert_eq!(Label::from("\u{ff43}\u{ff41}\u{ff46}\u{e9}"), cafe);
        let read: Label = serde_json::from_str(r#""cafe\u0301""#).unwrap();
        assert_eq!(read, cafe);
        assert_eq!(serde_json::to_string(&read).unwrap(), "\"caf\u{e9}\"");
    }

    #[test]
    fn labels_of_any_script_are_harmless() {
        for good in ["car", "ABCD 123", "véhicule", "می\u{200C}خواهم", "車"] {
            assert!(is_label(good), "{good}");
        }
        for bad in [
            "",
            "car\n",
            "car\u{202E}rac",
            "\u{2066}car",
            "car\u{2028}van",
            &"x".repeat(65),
        ] {
            assert!(!is_label(bad), "{}", bad.escape_unicode());
        }
    }
}
