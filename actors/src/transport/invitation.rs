//! Invitations: how a machine gets a certificate and the cell's key, while its private key stays on
//! it.
//!
//! ```text
//! host                                                     guest
//! token: addresses, certificate's SHA-256, secret   ->     carried over by a person
//!                TLS 1.3; the host's certificate must be the token's
//!                                                   <-     node, secret, certificate signing request
//! certificate, CA, revocation list, cell's key      ->
//!                                                   <-     "kept": all is on disk
//! "kept": the token is used up                       ->
//! ```
//!
//! A token is for one node. It works until the guest has stored its files, or the host ends. A
//! guest that fails before that can try again. Among all certificates issued for a token, only the
//! last one stays valid, and only if it was stored. The guest's clock does not matter.

mod guest;
mod host;
mod token;

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::Role;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncReadExt, AsyncWrite, AsyncWriteExt};

pub use guest::{JoinError, Joined, redeem};
#[cfg(fuzzing)]
pub use host::read_request;
pub use host::{Host, Visit};
#[cfg(fuzzing)]
pub use token::token_is_read_as_written;
pub use token::{Token, TokenError};

/// Maximum length of the host's answer in bytes. A revocation list is the longest part.
const MAX_REPLY_BYTES: u64 = 4 << 20;

/// Maximum length of a guest's message in bytes; unknown hosts can send one, too.
const MAX_REQUEST_BYTES: u64 = 16 << 10;

/// Maximum time for a conversation; the guest writes its files meanwhile.
const CONVERSATION_TIME: Duration = Duration::from_secs(10);

/// Name in the host's single-use certificate. The token identifies the certificate.
const HOST_NAME: &str = "invitation.ecod.internal";

/// The last message of both.
const KEPT: &str = "kept";

/// First message of the guest: its request for a certificate.
#[derive(Debug, Serialize, Deserialize)]
struct Request {
    node: NodeName,
    /// Hexadecimal digits.
    secret: String,
    /// Certificate signing request in PEM. Of its content, the public key alone counts.
    request: String,
}

/// Answer of the host to a request.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Reply {
    Welcome(Box<Welcome>),
    Refused(String),
}

/// All data that a node needs to join a cell, except its private key.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Welcome {
    /// Name of the cell.
    pub cell: NodeName,
    /// Highest role of the node.
    pub role: Role,
    /// The node's certificate in PEM.
    pub certificate: String,
    /// The CA's certificate in PEM.
    pub ca: String,
    /// The revocation list in PEM.
    pub revocation_list: String,
    /// Content of the cell's key file.
    pub cell_key: String,
    /// Nodes through which to find the cell, as `host:port`.
    pub seeds: Vec<String>,
    /// The city above the cell, whose vehicles may join it; absent for a cell that stands alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub city: Option<CityFiles>,
}

/// The files of a city that all nodes of its cells have.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct CityFiles {
    /// The certificate of the city's CA in PEM.
    pub ca: String,
    /// The city's revocation list in PEM.
    pub revocation_list: String,
}

/// Writes one message, a line of JSON.
async fn write_line(
    stream: &mut (impl AsyncWrite + Unpin),
    message: &impl Serialize,
) -> std::io::Result<()> {
    let line = serde_json::to_string(message)? + "\n";
    stream.write_all(line.as_bytes()).await?;
    stream.flush().await
}

/// Reads one message, a line of JSON of at most `max_bytes`.
async fn read_line<T: serde::de::DeserializeOwned>(
    stream: &mut (impl AsyncBufRead + Unpin),
    max_bytes: u64,
) -> std::io::Result<T> {
    let mut line = String::new();
    stream.take(max_bytes).read_line(&mut line).await?;
    Ok(serde_json::from_str(&line)?)
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;
    use std::sync::{Arc, Mutex};

    use tempfile::TempDir;
    use tokio::net::TcpListener;
    use tokio::task::JoinHandle;
    use tokio::time::{Instant, timeout};

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::{Authority, CertificateSubject};

    const SOON: Duration = Duration::from_secs(20);

    struct Scene {
        directory: TempDir,
        token: Token,
        visits: Arc<Mutex<Vec<String>>>,
        serving: JoinHandle<Vec<NodeName>>,
    }

    /// A host that waits for `gauss`.
    async fn host(wait: Duration) -> Scene {
        host_for(wait, &[]).await
    }

    /// As `host`, for several guests.
    async fn host_for(wait: Duration, others: &[&'static str]) -> Scene {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::init(
            directory.path(),
            &NodeName::from_static("lot"),
            clock::now(),
        )
        .unwrap();
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let addresses = vec![listener.local_addr().unwrap()];
        let mut host = Host::new(
            authority,
            "a key of the cell".into(),
            vec!["10.0.0.1:1".into()],
            None,
        )
        .unwrap();
        for other in others {
            host.invite(&NodeName::from_static(other), Role::Cav, addresses.clone())
                .unwrap();
        }
        let token = host
            .invite(&NodeName::from_static("gauss"), Role::Cav, addresses)
            .unwrap();
        let visits = Arc::<Mutex<Vec<String>>>::default();
        let noted = Arc::clone(&visits);
        let report = move |visit| noted.lock().unwrap().push(format!("{visit:?}"));
        let serving = tokio::spawn(host.serve(listener, Instant::now() + wait, report));
        Scene {
            directory,
            token,
            visits,
            serving,
        }
    }

    fn revoked(directory: &TempDir) -> usize {
        std::fs::read_to_string(directory.path().join("issued.json"))
            .unwrap()
            .matches("revoked_at_us")
            .count()
    }

    #[tokio::test]
    async fn lost_invitation_is_redeemable_once() {
        let Scene {
            directory,
            token,
            serving,
            ..
        } = host(SOON).await;
        let lost = redeem(&token).await.unwrap();
        drop(lost);
        assert_eq!(revoked(&directory), 0);
        let joined = redeem(&token).await.unwrap();
        assert_eq!(revoked(&directory), 1, "the certificate that was lost");
        let welcome = &joined.welcome;
        assert_eq!(
            (welcome.cell.as_str(), welcome.role, &*welcome.cell_key),
            ("lot", Role::Cav, "a key of the cell")
        );
        let certificate = <rustls::pki_types::CertificateDer<'_> as rustls::pki_types::pem::PemObject>::from_pem_slice(
            welcome.certificate.as_bytes(),
        );
        let subject = CertificateSubject::of(&certificate.unwrap()).unwrap();
        assert!(subject.name().as_str() == "gauss" && !subject.may_serve());
        joined.keep().await.unwrap();
        assert_eq!(
            timeout(SOON, serving).await.unwrap().unwrap(),
            [],
            "the host does not wait"
        );
        assert!(matches!(
            redeem(&token).await,
            Err(JoinError::Unreachable { .. })
        ));
    }

    #[tokio::test]
    async fn late_guests_are_named() {
        let wait = Duration::from_secs(2);
        let began = Instant::now();
        let Scene {
            token,
            mut serving,
            directory: _kept,
            ..
        } = host_for(wait, &["euclid", "noether"]).await;
        redeem(&token).await.unwrap().keep().await.unwrap();
        assert!(
            timeout(wait / 2, &mut serving).await.is_err(),
            "the others have time"
        );
        let left = timeout(SOON, serving).await.unwrap().unwrap();
        assert_eq!(left, ["euclid", "noether"].map(NodeName::from_static));
        assert!(began.elapsed() >= wait);
        assert!(matches!(
            redeem(&token).await,
            Err(JoinError::Unreachable { .. })
        ));
    }

    #[tokio::test]
    async fn later_of_two_guests_joins() {
        let Scene {
            directory,
            token,
            visits,
            serving,
        } = host(SOON).await;
        let first = redeem(&token).await.unwrap();
        let second = redeem(&token).await.unwrap();
        // Its certificate is already revoked, so its message does not count as the node's.
        first.keep().await.unwrap();
        let was_reported = |text: &str| {
            visits
                .lock()
                .unwrap()
                .iter()
                .any(|visit| visit.contains(text))
        };
        let deadline = Instant::now() + SOON;
        while !was_reported("used again") {
            assert!(Instant::now() < deadline, "{:?}", visits.lock().unwrap());
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        assert!(was_reported("UsedAgain"));
        second.keep().await.unwrap();
        assert_eq!(timeout(SOON, serving).await.unwrap().unwrap(), []);
        assert!(was_reported("Joined") && revoked(&directory) == 1);
    }

    #[tokio::test]
    async fn silent_strangers_delay_guest_briefly() {
        const STRANGERS: usize = host::MAX_VISITS + 6;
        let Scene {
            token,
            serving,
            directory: _directory,
            ..
        } = host(CONVERSATION_TIME + SOON).await;
        let mut silent = Vec::new();
        for _ in 0..STRANGERS {
            silent.push(
                tokio::net::TcpStream::connect(token.addresses[0])
                    .await
                    .unwrap(),
            );
        }
        let began = Instant::now();
        let refused = redeem(&token).await.err();
        assert!(
            matches!(refused, Some(JoinError::Unreachable { .. })),
            "{refused:?}"
        );
        let joined = loop {
            if let Ok(joined) = redeem(&token).await {
                break joined;
            }
            assert!(
                began.elapsed() < CONVERSATION_TIME + SOON,
                "held up for ever"
            );
        };
        assert!(
            began.elapsed() < CONVERSATION_TIME + Duration::from_secs(5),
            "{:?}",
            began.elapsed()
        );
        joined.keep().await.unwrap();
        assert_eq!(timeout(SOON, serving).await.unwrap().unwrap(), []);
    }

    #[tokio::test]
    async fn wrong_secret_or_host_is_refused() {
        let Scene {
            token,
            visits,
            serving,
            directory,
        } = host(Duration::from_secs(3)).await;
        let secret = Token {
            secret: [0; 16],
            ..token.clone()
        };
        let name = Token {
            node: NodeName::from_static("edge"),
            ..token.clone()
        };
        for token in [secret, name] {
            let refused = redeem(&token).await.err();
            assert!(
                matches!(refused, Some(JoinError::Refused(_))),
                "{refused:?}"
            );
        }
        let other_host = Token {
            fingerprint: [0; 32],
            ..token.clone()
        };
        let refused = redeem(&other_host).await.err();
        assert!(
            matches!(refused, Some(JoinError::Unreachable { .. })),
            "{refused:?}"
        );
        // Silent connections of unknown hosts don't take a guest's place.
        let mut silent = Vec::new();
        for _ in 0..20 {
            silent.push(
                tokio::net::TcpStream::connect(token.addresses[0])
                    .await
                    .unwrap(),
            );
        }
        drop(redeem(&token).await.unwrap());
        assert_eq!(
            timeout(SOON, serving).await.unwrap().unwrap(),
            [token.node],
            "it has not kept it"
        );
        assert_eq!(revoked(&directory), 1, "what was not kept is not valid");
        assert!(
            visits
                .lock()
                .unwrap()
                .iter()
                .all(|visit| visit.starts_with("Failed"))
        );
        assert!(
            !std::fs::read_to_string(directory.path().join("issued.json"))
                .unwrap()
                .contains("\"edge\"")
        );
    }
}
