//! The node that a certificate names.

use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use x509_parser::certificate::X509Certificate;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::FromDer;

use super::{BROKER_NAME, OBSERVER_MARK, RIGHTS_SCHEME};

/// The node that a certificate names, and its rights. Its signature is verified elsewhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CertificateSubject {
    name: NodeName,
    may_serve: bool,
    rights: Rights,
    validity: Validity,
}

/// The time in which a certificate is valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Validity {
    begins: Timestamp,
    expires: Timestamp,
}

/// Error for a certificate that names no node.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidCertificate {
    /// Not an X.509 certificate.
    #[error("not an X.509 certificate")]
    Malformed,
    /// The certificate has no common name, several common names, or a name that is not valid for a node.
    #[error("the certificate's common name is not the name of a node")]
    NoName,
    /// Role and priority that cannot be understood.
    #[error("the certificate's rights are not `ecod:role=auto|cav|edge;priority=0..255`")]
    Rights,
}

/// Remaining validity below which a certificate should be replaced.
const RENEWAL_MARGIN: Duration = Duration::from_secs(30 * 86_400);

/// The same for a certificate of the shortest validity: not later than its node stops leading.
const LAST_RENEWAL_MARGIN: Duration = Duration::from_secs(60);

impl CertificateSubject {
    /// Reads a certificate in DER.
    ///
    /// # Errors
    /// Returns an [`InvalidCertificate`] if it names no node.
    pub fn of(certificate: &[u8]) -> Result<Self, InvalidCertificate> {
        let (_, parsed) =
            X509Certificate::from_der(certificate).map_err(|_| InvalidCertificate::Malformed)?;
        let mut names = parsed.subject().iter_common_name();
        let (Some(name), None) = (names.next(), names.next()) else {
            return Err(InvalidCertificate::NoName);
        };
        let name = name
            .as_str()
            .ok()
            .and_then(|name| NodeName::new(name).ok())
            .ok_or(InvalidCertificate::NoName)?;
        let alternatives = parsed
            .subject_alternative_name()
            .ok()
            .flatten()
            .map(|names| &names.value.general_names[..])
            .unwrap_or_default();
        let may_serve = alternatives
            .iter()
            .any(|name| matches!(name, GeneralName::DNSName(BROKER_NAME)));
        let stated = alternatives.iter().find_map(|name| match name {
            GeneralName::URI(uri) => uri.strip_prefix(RIGHTS_SCHEME),
            _ => None,
        });
        let rights = match stated {
            _ if !may_serve => Rights::NONE,
            Some(rights) => parse_rights(rights).ok_or(InvalidCertificate::Rights)?,
            None => Rights::ALL,
        };
        Ok(Self {
            name,
            may_serve,
            rights,
            validity: Validity::read(&parsed),
        })
    }

    /// Reads a certificate in PEM.
    ///
    /// # Errors
    /// Returns an [`InvalidCertificate`] if it names no node.
    pub(crate) fn of_pem(certificate: &str) -> Result<Self, InvalidCertificate> {
        let certificate = CertificateDer::from_pem_slice(certificate.as_bytes())
            .map_err(|_| InvalidCertificate::Malformed)?;
        Self::of(&certificate)
    }

    /// Name of the node that the certificate is for.
    pub fn name(&self) -> &NodeName {
        &self.name
    }

    /// True if the node may serve a broker, and so lead.
    pub fn may_serve(&self) -> bool {
        self.may_serve
    }

    /// Beginning of the certificate's validity.
    pub fn begins(&self) -> Timestamp {
        self.validity.begins
    }

    /// Highest role and priority of the node in the election. A certificate of an early version
    /// without them allows all, if it is a broker's certificate.
    pub fn rights(&self) -> Rights {
        self.rights
    }

    /// The same node without the rights to lead and to serve a broker.
    #[must_use]
    pub(super) fn without_rights(self) -> Self {
        Self {
            may_serve: false,
            rights: Rights::NONE,
            ..self
        }
    }

    /// Rights of a node or observer that uses the certificate. An observer cannot lead.
    pub fn rights_of(&self, name: &NodeName) -> Rights {
        if *name == self.name {
            self.rights
        } else {
            Rights::NONE
        }
    }

    /// The remaining validity if the certificate should be replaced: if it ends within 30 days, or
    /// within a third of a shorter validity.
    pub fn due_for_renewal(&self, now: Timestamp) -> Option<Duration> {
        self.validity.remaining_within(RENEWAL_MARGIN, now)
    }

    /// End of the certificate's validity.
    pub fn expires(&self) -> Timestamp {
        self.validity.expires
    }

    /// True if the node may have a client of this name: its own name, or the name of a part or an
    /// observer that shares its certificate. Parts' observations count as their node's, so that one
    /// certificate is one vehicle.
    pub fn may_act_as(&self, name: &str) -> bool {
        name.strip_prefix(self.name.as_str())
            .is_some_and(|rest| rest.is_empty() || rest.starts_with(OBSERVER_MARK))
    }
}

impl Validity {
    /// Of a CA that is unknown.
    pub(super) const UNLIMITED: Self = Self {
        begins: Timestamp(0),
        expires: Timestamp(u64::MAX),
    };

    /// The validity of a certificate in DER, if it is one.
    pub(super) fn of(certificate: &[u8]) -> Option<Self> {
        let (_, parsed) = X509Certificate::from_der(certificate).ok()?;
        Some(Self::read(&parsed))
    }

    fn read(certificate: &X509Certificate<'_>) -> Self {
        let time =
            |seconds: i64| Timestamp(0) + Duration::from_secs(u64::try_from(seconds).unwrap_or(0));
        let validity = certificate.validity();
        Self {
            begins: time(validity.not_before.timestamp()),
            expires: time(validity.not_after.timestamp()),
        }
    }

    /// The remaining validity, if it is less than `margin` or than a third of the whole validity.
    pub(crate) fn remaining_within(self, margin: Duration, now: Timestamp) -> Option<Duration> {
        let whole = self.expires.since(self.begins);
        let margin = margin.min(whole / 3).max(LAST_RENEWAL_MARGIN.min(whole));
        let left = self.expires.since(now);
        (left < margin).then_some(left)
    }
}

/// The rights in a certificate, as its alternative name of kind URI.
pub(super) fn rights_uri(rights: Rights) -> String {
    let operator = if rights.may_describe {
        ";operator=yes"
    } else {
        ""
    };
    format!(
        "{RIGHTS_SCHEME}role={};priority={}{operator}",
        role_name(rights.role),
        rights.priority
    )
}

pub(super) fn role_name(role: Role) -> &'static str {
    match role {
        Role::Auto => "auto",
        Role::Cav => "cav",
        Role::Edge => "edge",
    }
}

/// Reads `role=auto;priority=100`; entries that later versions may add are ignored.
fn parse_rights(text: &str) -> Option<Rights> {
    let entry = |key: &str| {
        text.split(';')
            .find_map(|entry| entry.strip_prefix(key)?.strip_prefix('='))
    };
    let role = match entry("role")? {
        "auto" => Role::Auto,
        "cav" => Role::Cav,
        "edge" => Role::Edge,
        _ => return None,
    };
    Some(Rights {
        role,
        priority: entry("priority")?.parse().ok()?,
        may_describe: entry("operator") == Some("yes"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rights_round_trip() {
        let rights = Rights {
            priority: 7,
            ..Rights::from(Role::Auto)
        };
        assert_eq!(rights_uri(rights), "ecod:role=auto;priority=7");
        assert_eq!(
            rights_uri(rights.of_operator()),
            "ecod:role=auto;priority=7;operator=yes"
        );
        assert_eq!(
            parse_rights("role=auto;priority=7;operator=yes"),
            Some(rights.of_operator())
        );
        assert_eq!(parse_rights("role=auto;priority=7"), Some(rights));
        assert_eq!(parse_rights("zone=3;priority=7;role=auto"), Some(rights));
        for text in [
            "",
            "role=auto",
            "priority=7",
            "role=chief;priority=7",
            "role=auto;priority=256",
        ] {
            assert_eq!(parse_rights(text), None, "{text}");
        }
    }

    /// The subject of a certificate for `edge` with these alternative names.
    fn subject(names: Vec<rcgen::SanType>) -> Result<CertificateSubject, InvalidCertificate> {
        let mut parameters = rcgen::CertificateParams::default();
        parameters
            .distinguished_name
            .push(rcgen::DnType::CommonName, "edge");
        parameters.subject_alt_names = names;
        let certificate = parameters
            .self_signed(&rcgen::KeyPair::generate().unwrap())
            .unwrap();
        CertificateSubject::of(certificate.der())
    }

    #[test]
    fn certificate_without_rights_may_lead() {
        let broker = || rcgen::SanType::DnsName(BROKER_NAME.try_into().unwrap());
        let uri = |text: &str| rcgen::SanType::URI(text.try_into().unwrap());
        assert_eq!(subject(vec![broker()]).unwrap().rights(), Rights::ALL);
        assert_eq!(
            subject(vec![uri("https://example.org"), broker()])
                .unwrap()
                .rights(),
            Rights::ALL
        );
        assert_eq!(
            subject(Vec::new()).unwrap().rights(),
            Rights::NONE,
            "a vehicle's"
        );
        assert_eq!(
            subject(vec![uri("ecod:role=edge;priority=9")])
                .unwrap()
                .rights(),
            Rights::NONE,
            "without a broker"
        );
        let both = subject(vec![broker(), uri("ecod:role=auto;priority=9")]).unwrap();
        assert_eq!(
            both.rights(),
            Rights {
                priority: 9,
                ..Rights::from(Role::Auto)
            }
        );
        assert_eq!(
            both.rights_of(&NodeName::from_static("edge--top")),
            Rights::NONE,
            "an observer's"
        );
        assert_eq!(
            subject(vec![broker(), uri("ecod:role=chief")]),
            Err(InvalidCertificate::Rights)
        );
    }
}
