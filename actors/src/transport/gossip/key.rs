//! The cell's key, and the keys derived from it.

use std::num::NonZeroU32;

use ecod::model::names::NodeName;
use ring::{aead, digest, hkdf, hmac, pbkdf2};

use crate::platform::bounded_file;

use super::config::MembershipConfig;

/// One run of a node's membership, drawn at random.
pub(crate) type SessionId = [u8; 16];

/// Random number that makes the session unique for each run, in a cell with certificates.
pub(crate) type SessionNonce = [u8; 16];

/// The session of a node in a cell with certificates. Only a node of this name can show the nonce
/// of it.
pub(crate) fn session_of(name: &NodeName, nonce: &SessionNonce) -> SessionId {
    let text: [&[u8]; 3] = [b"ecod session 2", nonce, name.as_str().as_bytes()];
    let hash = digest::digest(&digest::SHA256, &text.concat());
    hash.as_ref().first_chunk().copied().unwrap_or_default()
}

/// Receiver in frames for all nodes of the cell.
pub(crate) const BROADCAST: SessionId = [0; 16];

/// The secret that all nodes of a cell share. All other keys are derived from it.
pub(crate) struct CellKey {
    root: hkdf::Prk,
    tag: [u8; 4],
}

/// Public tag of a cell in its frames, of the hash of its name.
pub(crate) fn cell_tag(cell: &NodeName) -> [u8; 4] {
    let hash = digest::digest(&digest::SHA256, cell.as_str().as_bytes());
    hash.as_ref().first_chunk().copied().unwrap_or_default()
}

/// A key that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The key file is not there or cannot be read.
    #[error("cannot read cell key {path}: {source}")]
    Unreadable {
        /// Path of the file.
        path: std::path::PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The key file holds less than a key.
    #[error("cell key in {path} must have at least 12 characters")]
    TooShort {
        /// Path of the file.
        path: std::path::PathBuf,
    },
}

/// Checks that the configured key can be used.
///
/// # Errors
/// Returns a [`KeyError`] if the key file cannot be used.
pub fn check_key(config: &MembershipConfig, cell: &NodeName) -> Result<(), KeyError> {
    CellKey::load(config, cell).map(drop)
}

/// The key that signs payloads, derived from the cell's key.
///
/// # Errors
/// Returns a [`KeyError`] if the key file cannot be used.
pub(crate) fn payload_key(
    config: &MembershipConfig,
    cell: &NodeName,
) -> Result<hmac::Key, KeyError> {
    CellKey::load(config, cell).map(|key| key.payload_key())
}

impl CellKey {
    /// Reads the configured key. Without one the key is derived from the cell's name, which
    /// separates cells and gives no protection.
    ///
    /// # Errors
    /// Returns a [`KeyError`] if the key file cannot be used.
    pub(crate) fn load(config: &MembershipConfig, cell: &NodeName) -> Result<Self, KeyError> {
        let Some(path) = &config.key_file else {
            return Ok(Self::new(
                config.key.as_ref().map_or("", |key| key.reveal().trim()),
                cell,
            ));
        };
        let text = bounded_file::read_text(path).map_err(|source| KeyError::Unreadable {
            path: path.clone(),
            source,
        })?;
        if text.trim().len() < super::config::MIN_KEY_BYTES {
            return Err(KeyError::TooShort { path: path.clone() });
        }
        Ok(Self::new(text.trim(), cell))
    }

    /// The key of a text: 64 hexadecimal digits as they are, any other text stretched by PBKDF2.
    pub(crate) fn new(text: &str, cell: &NodeName) -> Self {
        let mut secret = [0; 32];
        if hex::decode_to_slice(text, &mut secret).is_err() && !text.is_empty() {
            let salt = [b"ecod gossip 1 ", cell.as_str().as_bytes()].concat();
            pbkdf2::derive(
                pbkdf2::PBKDF2_HMAC_SHA256,
                PBKDF2_ROUNDS,
                &salt,
                text.as_bytes(),
                &mut secret,
            );
        }
        let root = hkdf::Salt::new(hkdf::HKDF_SHA256, cell.as_str().as_bytes()).extract(&secret);
        Self {
            root,
            tag: cell_tag(cell),
        }
    }

    /// The key that signs payloads sent through external brokers.
    #[expect(
        clippy::expect_used,
        reason = "the length asked for is fixed and allowed"
    )]
    pub(crate) fn payload_key(&self) -> hmac::Key {
        let info: [&[u8]; 1] = [b"ecod payload 1"];
        let key = self
            .root
            .expand(&info, hmac::HMAC_SHA256)
            .map(hmac::Key::from);
        key.expect("HKDF gives as much as a hash's length")
    }

    /// Public tag in every frame, which distinguishes cells.
    pub(crate) fn tag(&self) -> [u8; 4] {
        self.tag
    }

    /// The key of one session with certificates, derived from the shared secret of both sides and
    /// their transcript.
    #[expect(
        clippy::expect_used,
        reason = "the length asked for is fixed and allowed"
    )]
    pub(crate) fn session(&self, secret: &[u8], transcript: &[u8; 32]) -> Self {
        let info: [&[u8]; 2] = [b"ecod session 2", transcript];
        let salt = self
            .root
            .expand(&info, hkdf::HKDF_SHA256)
            .map(hkdf::Salt::from);
        Self {
            root: salt
                .expect("HKDF gives as much as a hash's length")
                .extract(secret),
            tag: self.tag,
        }
    }

    /// The cipher of frames from one session to another. The sender's frame counter is the nonce,
    /// so that every frame has a different pair of key and nonce.
    #[expect(
        clippy::expect_used,
        reason = "the length asked for is fixed and allowed"
    )]
    pub(crate) fn seal(&self, sender: &SessionId, receiver: &SessionId) -> FrameCipher {
        let info: [&[u8]; 3] = [b"ecod frame 1", sender, receiver];
        let key = self
            .root
            .expand(&info, &aead::CHACHA20_POLY1305)
            .map(aead::UnboundKey::from);
        FrameCipher(aead::LessSafeKey::new(
            key.expect("HKDF gives as much as a cipher's key"),
        ))
    }
}

/// Encrypts and decrypts the frames of one direction between two sessions.
pub(crate) struct FrameCipher(aead::LessSafeKey);

impl FrameCipher {
    /// Encrypts the bytes after the first `head` bytes of the frame, and authenticates the whole
    /// frame.
    #[expect(
        clippy::expect_used,
        reason = "the cipher seals 256 GiB, a datagram has 64 KiB"
    )]
    pub(crate) fn close(&self, counter: u64, frame: &mut Vec<u8>, head: usize) {
        let mut body = frame.split_off(head);
        let sealed =
            self.0
                .seal_in_place_append_tag(nonce(counter), aead::Aad::from(&frame[..]), &mut body);
        sealed.expect("a frame is shorter than what the cipher can seal");
        frame.append(&mut body);
    }

    /// The decrypted body of a frame, if the frame is authentic.
    pub(crate) fn open(&self, counter: u64, head: &[u8], body: &[u8]) -> Option<Vec<u8>> {
        let mut body = body.to_vec();
        let length = self
            .0
            .open_in_place(nonce(counter), aead::Aad::from(head), &mut body)
            .ok()?
            .len();
        body.truncate(length);
        Some(body)
    }
}

/// Issues cookies without storing them, as MACs over address and time.
pub(crate) struct CookieFactory(hmac::Key);

/// Proof of reachability: a node that returns a cookie has received it.
pub(crate) type Cookie = [u8; 16];

impl CookieFactory {
    pub(crate) fn new(secret: &[u8; 32]) -> Self {
        Self(hmac::Key::new(hmac::HMAC_SHA256, secret))
    }

    /// The cookie for a session at an address during one slot of time.
    pub(crate) fn issue(
        &self,
        session: &SessionId,
        address: std::net::SocketAddr,
        slot: u64,
    ) -> Cookie {
        let text = format!("{slot} {address}");
        let tag = hmac::sign(&self.0, &[&session[..], text.as_bytes()].concat());
        tag.as_ref().first_chunk().copied().unwrap_or_default()
    }
}

/// Rounds of PBKDF2 for a passphrase: about 50 ms for each guess on a small board's core.
const PBKDF2_ROUNDS: NonZeroU32 = NonZeroU32::new(100_000).expect("not zero");

fn nonce(counter: u64) -> aead::Nonce {
    let [a, b, c, d, e, f, g, h] = counter.to_be_bytes();
    aead::Nonce::assume_unique_for_key([0, 0, 0, 0, a, b, c, d, e, f, g, h])
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: SessionId = [1; 16];
    const B: SessionId = [2; 16];

    fn open(
        key: &CellKey,
        from: &SessionId,
        to: &SessionId,
        counter: u64,
        frame: &[u8],
    ) -> Option<Vec<u8>> {
        key.seal(from, to).open(counter, &frame[..4], &frame[4..])
    }

    #[test]
    fn frame_opens_with_sealing_context() {
        let cell = NodeName::from_static("lot-1");
        let key = CellKey::new("correct horse battery", &cell);
        let mut frame = b"headbody".to_vec();
        key.seal(&A, &B).close(7, &mut frame, 4);
        assert_eq!(open(&key, &A, &B, 7, &frame).as_deref(), Some(&b"body"[..]));
        assert_eq!(open(&key, &A, &B, 8, &frame), None);
        assert_eq!(open(&key, &B, &A, 7, &frame), None);
        assert_eq!(
            open(
                &CellKey::new("correct horse batterz", &cell),
                &A,
                &B,
                7,
                &frame
            ),
            None
        );
        let elsewhere = CellKey::new("correct horse battery", &NodeName::from_static("lot-2"));
        assert_eq!(open(&elsewhere, &A, &B, 7, &frame), None);
        for at in 0..frame.len() {
            let mut changed = frame.clone();
            changed[at] ^= 1;
            assert_eq!(open(&key, &A, &B, 7, &changed), None, "byte {at}");
        }
    }

    #[test]
    fn sixty_four_digits_are_raw_key() {
        let cell = NodeName::from_static("lot-1");
        let digits = "0aF1".repeat(16);
        let mut frame = b"headbody".to_vec();
        CellKey::new(&digits, &cell)
            .seal(&A, &B)
            .close(1, &mut frame, 4);
        let root = hkdf::Salt::new(hkdf::HKDF_SHA256, b"lot-1").extract(&[0x0a, 0xf1].repeat(16));
        assert_eq!(
            open(&CellKey { root, tag: [0; 4] }, &A, &B, 1, &frame).as_deref(),
            Some(&b"body"[..])
        );
        for other in [&digits[..63], &"g".repeat(64), &digits.to_lowercase()[..62]] {
            assert_eq!(open(&CellKey::new(other, &cell), &A, &B, 1, &frame), None);
        }
    }

    #[test]
    fn key_files_are_validated() {
        let cell = NodeName::from_static("lot-1");
        let file = tempfile::NamedTempFile::new().unwrap();
        let config = MembershipConfig {
            key_file: Some(file.path().into()),
            ..MembershipConfig::default()
        };
        std::fs::write(file.path(), " short\n").unwrap();
        assert!(
            CellKey::load(&config, &cell)
                .err()
                .unwrap()
                .to_string()
                .contains("12 characters")
        );
        std::fs::write(file.path(), "correct horse battery\n").unwrap();
        let mut frame = b"headbody".to_vec();
        CellKey::new("correct horse battery", &cell)
            .seal(&A, &B)
            .close(1, &mut frame, 4);
        assert!(open(&CellKey::load(&config, &cell).unwrap(), &A, &B, 1, &frame).is_some());
    }
}
