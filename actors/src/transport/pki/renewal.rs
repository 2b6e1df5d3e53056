//! Renewal of a node's certificate by a node that has the key of the cell's CA.
//!
//! ```text
//! node                                            every other node
//! certificate signing request for a new key  ->   one that has the CA's key compares the request with the certificate
//!                                                 that the sender has proven, and issues the same with a new validity
//!                                            <-   certificate, or the reason for a refusal
//! ```
//!
//! The conversation is two datagrams of the membership. Its sessions are encrypted and prove the
//! certificates of both sides, so the request contains only the new key; the private key stays on
//! the node. A lost datagram is repeated with the same key, for which the CA's node repeats its
//! answer.

use std::path::Path;

use rcgen::{CertificateParams, CertificateSigningRequestParams, KeyPair};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateSigningRequestDer};
use serde::{Deserialize, Serialize};
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;

use super::{Authority, Credentials, CredentialsError};
use crate::platform::clock;

/// A datagram of the conversation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum RenewalMessage {
    /// The sender requests a certificate with its name and rights for a new key: a certificate
    /// signing request in DER, of which only the key counts.
    Request(Vec<u8>),
    /// The new certificate in DER.
    Renewed(Vec<u8>),
    /// The reason for which the CA's node refuses the request.
    Refused(String),
}

/// The next key of a node, until there is a certificate for it.
pub(crate) struct NewKey {
    key: KeyPair,
    /// Certificate signing request in DER.
    pub(crate) request: Vec<u8>,
}

impl NewKey {
    pub(crate) fn generate() -> Result<Self, rcgen::Error> {
        let key = KeyPair::generate()?;
        let request = CertificateParams::default()
            .serialize_request(&key)?
            .der()
            .to_vec();
        Ok(Self { key, request })
    }

    /// True if a certificate in DER is for this key.
    pub(crate) fn is_in(&self, certificate: &[u8]) -> bool {
        X509Certificate::from_der(certificate).is_ok_and(|(_, certificate)| {
            *certificate.public_key().subject_public_key.data == *self.key.public_key_raw()
        })
    }

    /// Replaces the node's certificate and key by a new certificate and this key.
    ///
    /// # Errors
    /// Returns an error if the certificate is not the present certificate with another key and a later end,
    /// or the files cannot be written.
    pub(crate) fn install(
        &self,
        certificate: &[u8],
        credentials: &Credentials,
    ) -> Result<(), CredentialsError> {
        let secret = self.key.serialize_pem();
        credentials.replace(certificate, self.key.public_key_raw(), &secret)
    }

    /// Replaces the node's certificate, which may have ended, by a certificate of a CA on this machine.
    ///
    /// # Errors
    /// Returns the reason as text.
    pub(crate) fn reissue(
        &self,
        authority: &mut Authority,
        credentials: &Credentials,
    ) -> Result<(), String> {
        let present = credentials.current();
        let pem = authority
            .reissue(present.certificate(), &self.key, clock::wall())
            .map_err(|refusal| refusal.to_string())?;
        let renewed = der_of(&pem)?;
        self.install(&renewed, credentials)
            .map_err(|error| error.to_string())
    }
}

/// The new certificate, in DER, of a node that has proven its present one, from the CA in a
/// directory.
///
/// # Errors
/// Returns the reason as text.
pub(crate) fn renew(
    directory: &Path,
    certificate: &[u8],
    request: Vec<u8>,
) -> Result<Vec<u8>, String> {
    let der = CertificateSigningRequestDer::from(request);
    let request = CertificateSigningRequestParams::from_der(&der)
        .map_err(|error| format!("the certificate signing request cannot be used: {error}"))?;
    let mut authority = Authority::open(directory).map_err(|error| error.to_string())?;
    let renewed = authority
        .renew(certificate, &request.public_key, clock::wall())
        .map_err(|refusal| refusal.to_string())?;
    der_of(&renewed)
}

fn der_of(certificate: &str) -> Result<Vec<u8>, String> {
    let certificate = CertificateDer::from_pem_slice(certificate.as_bytes());
    certificate
        .map(|certificate| certificate.to_vec())
        .map_err(|error| error.to_string())
}
