//! Proof of a node's certificate outside TLS: the membership's handshake uses the same files, CA
//! and revocation list.

use std::time::Duration;

use ring::signature::{ECDSA_P256_SHA256_ASN1, UnparsedPublicKey};
use rustls::crypto::ring::sign::any_ecdsa_type;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::sign::Signer;
use rustls::{CertificateError, SignatureScheme};
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;
use x509_parser::revocation_list::CertificateRevocationList;

use super::{CertificateSubject, InvalidCertificate, LoadedCredentials};

/// Largest certificate in DER that fits a handshake's datagram.
pub(crate) const MAX_CERTIFICATE_BYTES: usize = 840;

/// The reason why a certificate proves no node of the cell.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum Distrust {
    /// Not of the cell's CA, not valid now, revoked, or not for clients.
    #[error("{0}")]
    Untrusted(rustls::Error),
    /// It names no node.
    #[error(transparent)]
    Invalid(#[from] InvalidCertificate),
}

impl LoadedCredentials {
    /// The node's own certificate in DER.
    pub(crate) fn certificate(&self) -> &[u8] {
        self.certificates
            .first()
            .map_or(&[], |certificate| certificate)
    }

    /// The signature of a message by the node's key: ECDSA over P-256 with SHA-256, in DER.
    pub(crate) fn sign(&self, message: &[u8]) -> Result<Vec<u8>, rustls::Error> {
        self.signer.sign(message)
    }

    /// Verifies that a certificate is directly signed by the cell's CA, valid at this time and not
    /// revoked.
    pub(crate) fn verify_node(
        &self,
        certificate: &[u8],
        wall: UnixTime,
    ) -> Result<CertificateSubject, Distrust> {
        let subject = self.subject_of(certificate)?;
        let verified =
            self.clients
                .verify_client_cert(&CertificateDer::from(certificate), &[], wall);
        verified.map(|_| subject).map_err(Distrust::Untrusted)
    }

    /// True if the cell's CA has revoked a certificate, which may have expired, or the city has
    /// revoked the cell's CA.
    pub(crate) fn has_revoked(&self, certificate: &[u8]) -> bool {
        if self
            .revoked_cas
            .iter()
            .any(|ca| is_issued_by(ca, certificate))
        {
            return true;
        }
        let Some(began) = began(certificate) else {
            return false;
        };
        let verified =
            self.clients
                .verify_client_cert(&CertificateDer::from(certificate), &[], began);
        verified.is_err_and(|error| {
            error == rustls::Error::InvalidCertificate(CertificateError::Revoked)
        })
    }
}

/// True if a CA has signed a certificate, by ECDSA over P-256 with SHA-256.
pub(super) fn is_issued_by(ca: &[u8], certificate: &[u8]) -> bool {
    let (Ok((_, ca)), Ok((_, certificate))) = (
        X509Certificate::from_der(ca),
        X509Certificate::from_der(certificate),
    ) else {
        return false;
    };
    let key = &ca.public_key().subject_public_key.data;
    let signature = &certificate.signature_value.data;
    certificate.issuer() == ca.subject()
        && is_signed_with(key, certificate.tbs_certificate.as_ref(), signature)
}

/// True if a revocation list was issued by a CA, which signs it by ECDSA over P-256 with SHA-256.
pub(super) fn is_list_of(ca: &[u8], list: &[u8]) -> bool {
    let (Ok((_, ca)), Ok((_, list))) = (
        X509Certificate::from_der(ca),
        CertificateRevocationList::from_der(list),
    ) else {
        return false;
    };
    let key = &ca.public_key().subject_public_key.data;
    let signature = &list.signature_value.data;
    list.issuer() == ca.subject() && is_signed_with(key, list.tbs_cert_list.as_ref(), signature)
}

/// Time at which a certificate's validity begins.
pub(super) fn began(certificate: &[u8]) -> Option<UnixTime> {
    let (_, parsed) = X509Certificate::from_der(certificate).ok()?;
    let began = u64::try_from(parsed.validity().not_before.timestamp()).ok()?;
    Some(UnixTime::since_unix_epoch(Duration::from_secs(began)))
}

/// Signer with a node's key; `None` for a key other than ECDSA P-256.
pub(super) fn signer(key: &PrivateKeyDer<'_>) -> Option<Box<dyn Signer>> {
    any_ecdsa_type(key)
        .ok()?
        .choose_scheme(&[SignatureScheme::ECDSA_NISTP256_SHA256])
}

/// True if a private key belongs to a certificate.
pub(super) fn is_key_of(key: &PrivateKeyDer<'_>, certificate: &[u8]) -> bool {
    let (Ok(key), Ok((_, certificate))) =
        (any_ecdsa_type(key), X509Certificate::from_der(certificate))
    else {
        return false;
    };
    key.public_key()
        .is_some_and(|public| certificate.public_key().raw == public.as_ref())
}

/// True if the owner of a certificate signed a message.
pub(crate) fn is_signed_by(certificate: &[u8], message: &[u8], signature: &[u8]) -> bool {
    let Ok((_, parsed)) = X509Certificate::from_der(certificate) else {
        return false;
    };
    is_signed_with(
        &parsed.public_key().subject_public_key.data,
        message,
        signature,
    )
}

/// True if the owner of a public key signed a message.
pub(super) fn is_signed_with(public_key: &[u8], message: &[u8], signature: &[u8]) -> bool {
    UnparsedPublicKey::new(&ECDSA_P256_SHA256_ASN1, public_key)
        .verify(message, signature)
        .is_ok()
}
