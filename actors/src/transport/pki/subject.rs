//! The node that a certificate names.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use x509_parser::certificate::X509Certificate;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::FromDer;

use super::{BROKER_NAME, OBSERVER_MARK};

/// The node that a certificate names, and its rights. Its signature is verified elsewhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CertificateSubject {
    name: NodeName,
    may_serve: bool,
    begins: Timestamp,
    expires: Timestamp,
}

/// A certificate that names no node.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidCertificate {
    /// Not an X.509 certificate.
    #[error("not an X.509 certificate")]
    Malformed,
    /// Not exactly one common name, or one that is not a node's name.
    #[error("the certificate's common name is not the name of a node")]
    NoName,
}

impl CertificateSubject {
    /// Reads a certificate in DER.
    ///
    /// # Errors
    /// [`InvalidCertificate`] when it names no node.
    pub fn of(certificate: &[u8]) -> Result<Self, InvalidCertificate> {
        let (_, parsed) = X509Certificate::from_der(certificate).map_err(|_| InvalidCertificate::Malformed)?;
        let mut names = parsed.subject().iter_common_name();
        let (Some(name), None) = (names.next(), names.next()) else { return Err(InvalidCertificate::NoName) };
        let name = name.as_str().ok().and_then(|name| NodeName::new(name).ok()).ok_or(InvalidCertificate::NoName)?;
        let alternatives = parsed.subject_alternative_name().ok().flatten();
        let may_serve = alternatives.is_some_and(|names| {
            names.value.general_names.iter().any(|name| matches!(name, GeneralName::DNSName(BROKER_NAME)))
        });
        let time = |seconds: i64| Timestamp(0) + Duration::from_secs(u64::try_from(seconds).unwrap_or(0));
        let validity = parsed.validity();
        let (begins, expires) = (time(validity.not_before.timestamp()), time(validity.not_after.timestamp()));
        Ok(Self { name, may_serve, begins, expires })
    }

    /// The node's name.
    pub fn name(&self) -> &NodeName {
        &self.name
    }

    /// Whether the node may serve a broker, and so lead.
    pub fn may_serve(&self) -> bool {
        self.may_serve
    }

    /// Beginning of the certificate's validity.
    pub fn begins(&self) -> Timestamp {
        self.begins
    }

    /// End of the certificate's validity.
    pub fn expires(&self) -> Timestamp {
        self.expires
    }

    /// Whether the node may have a client of this name: its own, or that of an observer which shares its certificate. An
    /// observer publishes nothing but a status, so that one certificate is one vehicle.
    pub fn may_act_as(&self, name: &str) -> bool {
        name.strip_prefix(self.name.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with(OBSERVER_MARK))
    }
}
