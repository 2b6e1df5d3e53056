//! TLS with brokers that are identified by a name instead of their address.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::{ClientConfig, DigitallySignedStruct, RootCertStore, SignatureScheme};

use crate::Error;

/// Certificates of a program, in PEM files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tls {
    /// Certificate authorities of which one must have signed the broker's certificate chain.
    pub ca: PathBuf,
    /// Certificate and key of the program's node, with which the program authenticates to the
    /// broker.
    pub identity: Option<(PathBuf, PathBuf)>,
    /// Name in the broker's certificate; without it, the host of the address.
    pub broker_name: Option<String>,
}

impl Tls {
    /// Name of the broker of a node that may lead.
    pub const BROKER_NAME: &'static str = "broker.ecod.internal";

    /// Name of the local broker of every node.
    pub const DOOR_NAME: &'static str = "door.ecod.internal";

    /// TLS with the local broker of any node, using the files of the program's own node.
    pub fn of_door(
        ca: impl Into<PathBuf>,
        certificate: impl Into<PathBuf>,
        key: impl Into<PathBuf>,
    ) -> Self {
        let broker_name = Some(Self::DOOR_NAME.to_owned());
        Self {
            ca: ca.into(),
            identity: Some((certificate.into(), key.into())),
            broker_name,
        }
    }

    /// TLS with the broker of a node that may lead, using the files of the program's own node.
    pub fn of_cell(
        ca: impl Into<PathBuf>,
        certificate: impl Into<PathBuf>,
        key: impl Into<PathBuf>,
    ) -> Self {
        Self {
            broker_name: Some(Self::BROKER_NAME.to_owned()),
            ..Self::of_door(ca, certificate, key)
        }
    }

    pub(crate) fn client(&self) -> Result<ClientConfig, Error> {
        let invalid = |path: &Path, error: &dyn std::fmt::Display| {
            Error::Invalid(format!("{}: {error}", path.display()))
        };
        let certificates = |path: &PathBuf| {
            let certificates = CertificateDer::pem_file_iter(path)
                .and_then(Iterator::collect::<Result<Vec<_>, _>>);
            certificates.map_err(|error| invalid(path, &error))
        };
        let mut roots = RootCertStore::empty();
        for certificate in certificates(&self.ca)? {
            roots
                .add(certificate)
                .map_err(|error| invalid(&self.ca, &error))?;
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier =
            WebPkiServerVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
                .build()
                .map_err(|error| invalid(&self.ca, &error))?;
        let name = self
            .broker_name
            .clone()
            .map(ServerName::try_from)
            .transpose()
            .map_err(|error| {
                Error::Invalid(format!("broker_name {:?}: {error}", self.broker_name))
            })?;
        let verifier = Arc::new(NamedBroker { verifier, name });
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| Error::Invalid(error.to_string()))?
            .dangerous()
            .with_custom_certificate_verifier(verifier);
        let Some((certificate, key)) = &self.identity else {
            return Ok(builder.with_no_client_auth());
        };
        let secret = PrivateKeyDer::from_pem_file(key).map_err(|error| invalid(key, &error))?;
        builder
            .with_client_auth_cert(certificates(certificate)?, secret)
            .map_err(|error| invalid(key, &error))
    }
}

/// Verifier of a broker that may have another name than its address.
#[derive(Debug)]
struct NamedBroker {
    verifier: Arc<WebPkiServerVerifier>,
    name: Option<ServerName<'static>>,
}

impl ServerCertVerifier for NamedBroker {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        host: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let name = self.name.as_ref().unwrap_or(host);
        self.verifier
            .verify_server_cert(end_entity, intermediates, name, ocsp_response, now)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier
            .verify_tls12_signature(message, certificate, signature)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier
            .verify_tls13_signature(message, certificate, signature)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.verifier.supported_verify_schemes()
    }
}
