//! Text that a person carries from the host to the guest.

use std::fmt;
use std::net::SocketAddr;
use std::str::FromStr;

use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use ecod::model::names::NodeName;
use ring::digest::{SHA256, digest};
use serde::{Deserialize, Serialize};

/// An invitation of one node.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Token {
    /// The node that may join.
    pub node: NodeName,
    /// Addresses of the host, which the guest tries in this order.
    pub addresses: Vec<SocketAddr>,
    /// SHA-256 of the host's certificate.
    pub(super) fingerprint: [u8; 32],
    pub(super) secret: [u8; 16],
}

/// A text that is not a token, or not a whole one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "this is not a complete token; `ecod-node invite NAME` prints one, which begins with `{PREFIX}`"
)]
pub struct TokenError;

/// Beginning of each token: kind and version.
const PREFIX: &str = "ecod1-";

/// Length of the checksum at the end of a token, in bytes.
const CHECKSUM_BYTES: usize = 4;

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let content = postcard::to_allocvec(self).map_err(|_| fmt::Error)?;
        f.write_str(&text_of(content))
    }
}

/// The text of a token with this content.
fn text_of(mut content: Vec<u8>) -> String {
    let hash = digest(&SHA256, &content);
    content.extend_from_slice(&hash.as_ref()[..CHECKSUM_BYTES]);
    PREFIX.to_owned() + &BASE64_URL_SAFE_NO_PAD.encode(content)
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Token")
            .field("node", &self.node)
            .field("addresses", &self.addresses)
            .finish_non_exhaustive()
    }
}

impl FromStr for Token {
    type Err = TokenError;

    fn from_str(text: &str) -> Result<Self, TokenError> {
        // A terminal, a chat or a mail program may have broken a long line with visible or invisible
        // characters, and added quotation marks.
        let is_of_token = |c: &char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        let is_quote = |c: char| matches!(c, '"' | '\'' | '`' | '>' | '«' | '»' | '‘'..='‟');
        let is_invisible = |c: char| {
            matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}')
                || matches!(c, '\u{2060}'..='\u{2069}' | '\u{feff}')
        };
        let is_between = |c: char| c.is_whitespace() || is_quote(c) || is_invisible(c);
        if text.chars().any(|c| !is_of_token(&c) && !is_between(c)) {
            return Err(TokenError);
        }
        let text: String = text.chars().filter(is_of_token).collect();
        let encoded = text.strip_prefix(PREFIX).ok_or(TokenError)?;
        let bytes = BASE64_URL_SAFE_NO_PAD
            .decode(encoded)
            .map_err(|_| TokenError)?;
        let (content, checksum) = bytes
            .split_last_chunk::<CHECKSUM_BYTES>()
            .ok_or(TokenError)?;
        if !digest(&SHA256, content).as_ref().starts_with(checksum) {
            return Err(TokenError);
        }
        postcard::from_bytes(content).map_err(|_| TokenError)
    }
}

/// True if a token with this content, if it is one, is read as it is written. Only built for the
/// fuzz targets.
#[cfg(fuzzing)]
pub fn token_is_read_as_written(content: &[u8]) -> bool {
    let token: Result<Token, _> = text_of(content.to_vec()).parse();
    token.map_or(true, |token| token.to_string().parse() == Ok(token))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn token_round_trips_only_whole() {
        let addresses = vec![
            "192.168.1.10:40000".parse().unwrap(),
            "[fe80::1]:40000".parse().unwrap(),
        ];
        let token = Token {
            node: NodeName::from_static("gauss"),
            addresses,
            fingerprint: [7; 32],
            secret: [0xd3; 16],
        };
        let text = token.to_string();
        assert!(text.len() < 160, "{text}");
        assert_eq!(format!(" {text}\n").parse(), Ok(token.clone()));
        for at in 0..text.len() {
            let (before, after) = text.split_at(at);
            for blank in [
                "\n",
                "\r\n  ",
                " ",
                "\n> ",
                "\u{a0}\u{feff}",
                "\u{ad}\u{200d}",
            ] {
                assert_eq!(
                    format!("{before}{blank}{after}").parse(),
                    Ok(token.clone()),
                    "{blank:?} at {at}"
                );
            }
        }
        for [before, after] in [
            ["\"", "\""],
            ["“", "”"],
            ["`", "`"],
            ["\u{2066}„", "“\u{2069}"],
        ] {
            let quoted = format!("{before}{text}{after}");
            assert_eq!(quoted.parse(), Ok(token.clone()), "{quoted}");
        }
        assert!(text.replacen('-', "=", 1).parse::<Token>().is_err());
        assert!(
            !format!("{token:?}").contains("d3") && !format!("{token:?}").contains("211"),
            "{token:?}"
        );
        for cut in 0..text.len() {
            assert_eq!(
                text[..cut].parse::<Token>(),
                Err(TokenError),
                "{cut} characters"
            );
        }
        let swapped = text.replacen('d', "e", 1);
        assert_eq!(swapped.parse::<Token>(), Err(TokenError));
    }
}
