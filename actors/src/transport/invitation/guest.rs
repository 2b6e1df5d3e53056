//! The side that joins.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use rcgen::{CertificateParams, KeyPair};
use ring::digest::{SHA256, digest};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{
    CryptoProvider, ring as provider, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{CertificateError, ClientConfig, DigitallySignedStruct, SignatureScheme};
use tokio::io::BufStream;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::{
    CONVERSATION_TIME, HOST_NAME, KEPT, MAX_REPLY_BYTES, MAX_REQUEST_BYTES, Reply, Request, Token,
    Welcome, read_line, write_line,
};

/// Maximum time for a connection to one address of the host.
const CONNECT_TIME: Duration = Duration::from_secs(3);

/// Time between the attempts at two addresses, some of which are out of reach (RFC 8305, section
/// 5).
const ATTEMPT_INTERVAL: Duration = Duration::from_millis(250);

/// A node that was admitted. The host counts it as joined after [`Joined::keep`].
pub struct Joined {
    /// Certificate, cell's key and the rest.
    pub welcome: Welcome,
    /// The node's private key in PEM, which stays on this machine.
    pub key: String,
    stream: BufStream<TlsStream<TcpStream>>,
}

/// A failure to join; the token remains valid.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// No address of the host can be reached.
    #[error(
        "no host at {addresses}: is `ecod-node invite` still running there, and the address reachable? ({reason})"
    )]
    Unreachable {
        /// All that were tried.
        addresses: String,
        /// Error of the last attempt.
        reason: String,
    },
    /// The host refuses the request; the value is its reason.
    #[error("refused: {0}; ask for a new token by `ecod-node invite`")]
    Refused(String),
    /// Another program than the host is there, or the conversation broke off.
    #[error("the host did not answer as it should: {0}")]
    Conversation(#[from] io::Error),
    /// No key could be made.
    #[error("no key could be made: {0}")]
    Key(#[from] rcgen::Error),
}

/// Requests admission from the host of a token.
///
/// # Errors
/// Returns a [`JoinError`].
pub async fn redeem(token: &Token) -> Result<Joined, JoinError> {
    let key = KeyPair::generate()?;
    let signing = CertificateParams::default()
        .serialize_request(&key)?
        .pem()?;
    let request = Request {
        node: token.node.clone(),
        secret: hex::encode(token.secret),
        request: signing,
    };
    let conversation = async {
        let mut stream = BufStream::new(connect(token).await?);
        write_line(&mut stream, &request).await?;
        let reply: Reply = read_line(&mut stream, MAX_REPLY_BYTES).await?;
        match reply {
            Reply::Welcome(welcome) => Ok(Joined {
                welcome: *welcome,
                key: key.serialize_pem(),
                stream,
            }),
            Reply::Refused(reason) => Err(JoinError::Refused(reason)),
        }
    };
    let late = |_| JoinError::Conversation(io::ErrorKind::TimedOut.into());
    let attempts = u32::try_from(token.addresses.len()).unwrap_or(u32::MAX);
    let connect_time = CONNECT_TIME + ATTEMPT_INTERVAL.saturating_mul(attempts);
    timeout(connect_time + CONVERSATION_TIME, conversation)
        .await
        .map_err(late)?
}

impl Joined {
    /// Confirms to the host that all files are on disk, so that the token is used up.
    ///
    /// # Errors
    /// Returns an error if the host does not acknowledge the confirmation: it will then revoke the
    /// certificate.
    pub async fn keep(mut self) -> io::Result<()> {
        let conversation = async {
            write_line(&mut self.stream, &KEPT).await?;
            read_line::<String>(&mut self.stream, MAX_REQUEST_BYTES).await
        };
        timeout(CONVERSATION_TIME, conversation).await?.map(drop)
    }
}

async fn connect(token: &Token) -> Result<TlsStream<TcpStream>, JoinError> {
    let provider = Arc::new(provider::default_provider());
    let verifier = PinnedVerifier {
        fingerprint: token.fingerprint,
        provider: Arc::clone(&provider),
    };
    let config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(io::Error::other)?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(verifier))
        .with_no_client_auth();
    let connector = TlsConnector::from(Arc::new(config));
    let name = ServerName::try_from(HOST_NAME).map_err(io::Error::other)?;
    let connect_to = async |address: &SocketAddr, number| {
        sleep(ATTEMPT_INTERVAL.saturating_mul(number)).await;
        let attempt = async {
            let stream = TcpStream::connect(address).await?;
            connector.connect(name.clone(), stream).await
        };
        let connected = timeout(CONNECT_TIME, attempt)
            .await
            .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()));
        connected.map_err(|error| format!("{address}: {error}"))
    };
    let mut attempts: FuturesUnordered<_> = token
        .addresses
        .iter()
        .zip(0..)
        .map(|(address, number)| connect_to(address, number))
        .collect();
    let mut reason = String::from("the token names no address");
    while let Some(connected) = attempts.next().await {
        match connected {
            Ok(stream) => return Ok(stream),
            Err(error) => reason = error,
        }
    }
    let addresses: Vec<String> = token.addresses.iter().map(ToString::to_string).collect();
    Err(JoinError::Unreachable {
        addresses: addresses.join(", "),
        reason,
    })
}

/// Trust in one certificate, independent of its names and validity.
#[derive(Debug)]
struct PinnedVerifier {
    fingerprint: [u8; 32],
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for PinnedVerifier {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        if digest(&SHA256, certificate).as_ref() == self.fingerprint {
            Ok(ServerCertVerified::assertion())
        } else {
            Err(CertificateError::ApplicationVerificationFailure.into())
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls12_signature(
            message,
            certificate,
            signature,
            &self.provider.signature_verification_algorithms,
        )
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls13_signature(
            message,
            certificate,
            signature,
            &self.provider.signature_verification_algorithms,
        )
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider
            .signature_verification_algorithms
            .supported_schemes()
    }
}
