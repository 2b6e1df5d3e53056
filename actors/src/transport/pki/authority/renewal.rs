//! Renewal of certificates: same name and rights, new key and validity.

use std::time::Duration;

use ecod::model::time::Timestamp;
use rcgen::PublicKeyData;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;

use super::super::attestation::is_issued_by;
use super::super::{CertificateSubject, InvalidCertificate};
use super::{Authority, AuthorityError, clock_allowance, read, read_register};

/// The reason why the CA does not renew a certificate.
#[derive(Debug, thiserror::Error)]
pub enum RenewalRefusal {
    /// It names no node.
    #[error(transparent)]
    Invalid(#[from] InvalidCertificate),
    /// Another CA has issued it.
    #[error("this CA has not issued its certificate")]
    NotIssued,
    /// The certificate was revoked.
    #[error("its certificate was revoked")]
    Revoked,
    /// The certificate has expired.
    #[error("its certificate has ended")]
    Ended,
    /// It does not end soon.
    #[error("its certificate does not end soon")]
    NotDue,
    /// A renewed certificate is as good as new.
    #[error("its certificate was renewed a moment ago")]
    TooSoon,
    /// The CA cannot be used.
    #[error(transparent)]
    Authority(#[from] AuthorityError),
}

/// Part of a certificate's validity in which the CA renews it once at most: a stolen certificate
/// fills no register.
const RENEWALS_PER_VALIDITY: u32 = 100;

impl Authority {
    /// Renews a valid certificate that ends soon, for a new key; returns the new certificate in PEM.
    ///
    /// # Errors
    /// Returns a [`RenewalRefusal`]; the certificate then stays as it is.
    pub(crate) fn renew(
        &mut self,
        certificate: &[u8],
        key: &impl PublicKeyData,
        now: Timestamp,
    ) -> Result<String, RenewalRefusal> {
        let subject = self.issued_to(certificate)?;
        if now >= subject.expires() {
            return Err(RenewalRefusal::Ended);
        }
        if subject.due_for_renewal(now).is_none() {
            return Err(RenewalRefusal::NotDue);
        }
        let valid = validity(&subject);
        let end = now + valid;
        let recent = end - valid / RENEWALS_PER_VALIDITY..=end;
        let mut issued = self.register.issued.iter();
        if issued.any(|issued| {
            issued.node == *subject.name()
                && issued.revoked_at_us.is_none()
                && recent.contains(&issued.expires_at_us)
        }) {
            return Err(RenewalRefusal::TooSoon);
        }
        self.reissue(certificate, key, now)
    }

    /// Issues a certificate again for a new key, also after its end; returns it in PEM.
    ///
    /// # Errors
    /// Returns a [`RenewalRefusal`] if the CA has not issued it, or has revoked it.
    pub(crate) fn reissue(
        &mut self,
        certificate: &[u8],
        key: &impl PublicKeyData,
        now: Timestamp,
    ) -> Result<String, RenewalRefusal> {
        let subject = self.issued_to(certificate)?;
        let name = subject.name();
        let rights = subject.rights();
        let (renewed, _) = self.certify(name, rights, validity(&subject), now, key)?;
        Ok(renewed)
    }

    /// The node of a certificate that this CA has issued and not revoked.
    fn issued_to(&mut self, certificate: &[u8]) -> Result<CertificateSubject, RenewalRefusal> {
        let subject = CertificateSubject::of(certificate)?;
        let ca = CertificateDer::from_pem_slice(read(&self.ca())?.as_bytes())
            .map_err(|error| AuthorityError::Crypto(error.to_string()))?;
        let (_, parsed) =
            X509Certificate::from_der(certificate).map_err(|_| InvalidCertificate::Malformed)?;
        let serial = hex::encode(parsed.raw_serial());
        self.register = read_register(&self.directory)?;
        let issued = self
            .register
            .issued
            .iter()
            .filter(|issued| issued.serial == serial && issued.node == *subject.name())
            .find(|_| is_issued_by(&ca, certificate))
            .ok_or(RenewalRefusal::NotIssued)?;
        if issued.revoked_at_us.is_some() {
            return Err(RenewalRefusal::Revoked);
        }
        Ok(subject)
    }
}

/// The time for which a certificate was issued.
fn validity(subject: &CertificateSubject) -> Duration {
    let whole = subject.expires().since(subject.begins());
    whole - clock_allowance(whole * 10 / 11)
}

#[cfg(test)]
mod tests {
    use ecod::leadership::Rights;
    use ecod::model::names::NodeName;
    use ecod::wire::Role;
    use rcgen::KeyPair;

    use super::*;
    use crate::platform::clock;

    const DAY: Duration = Duration::from_secs(86_400);
    const EUCLID: NodeName = NodeName::from_static("euclid");

    /// The certificate of `euclid` in DER, with the highest priority of an operator.
    fn issue(authority: &mut Authority, valid: Duration, issued_at: Timestamp) -> Vec<u8> {
        let rights = Rights {
            priority: 7,
            ..Rights::from(Role::Auto)
        };
        authority
            .issue(&EUCLID, rights.of_operator(), valid, issued_at)
            .unwrap();
        let (certificate, _) = authority.files_of(&EUCLID);
        CertificateDer::from_pem_file(certificate).unwrap().to_vec()
    }

    fn authority(directory: &std::path::Path) -> Authority {
        Authority::init(directory, &NodeName::from_static("lot"), clock::wall()).unwrap()
    }

    fn subject(pem: &str) -> CertificateSubject {
        CertificateSubject::of_pem(pem).unwrap()
    }

    #[test]
    fn renewal_keeps_name_and_rights() {
        let directory = tempfile::tempdir().unwrap();
        let now = clock::wall();
        let mut authority = authority(directory.path());
        for valid in [Duration::from_secs(180), 90 * DAY, 365 * DAY] {
            let before = issue(&mut authority, valid, now - valid * 19 / 20);
            let key = KeyPair::generate().unwrap();
            let renewed = authority.renew(&before, &key, now).unwrap();
            let renewed = subject(&renewed);
            let before = CertificateSubject::of(&before).unwrap();
            assert_eq!(renewed.name(), before.name());
            assert_eq!(renewed.rights(), before.rights());
            let whole = |it: &CertificateSubject| it.expires().since(it.begins()).as_secs();
            assert!(whole(&renewed).abs_diff(whole(&before)) <= 1, "{valid:?}");
            let late = renewed.expires().micros_from(now + valid);
            assert!(late.abs() <= 2_000_000, "{valid:?}: {late} µs");
        }
    }

    #[test]
    fn only_expiring_certificate_is_renewed() {
        let [directory, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let mut authority = authority(directory.path());
        let now = clock::wall();
        let key = KeyPair::generate().unwrap();
        let renew = |certificate: &[u8], authority: &mut Authority| {
            authority.renew(certificate, &key, now).map(drop)
        };
        let new = issue(&mut authority, 90 * DAY, now);
        assert!(matches!(
            renew(&new, &mut authority),
            Err(RenewalRefusal::NotDue)
        ));
        let ended = issue(&mut authority, 90 * DAY, now - 91 * DAY);
        assert!(matches!(
            renew(&ended, &mut authority),
            Err(RenewalRefusal::Ended)
        ));
        let foreign = issue(&mut self::authority(other.path()), 90 * DAY, now - 80 * DAY);
        assert!(matches!(
            renew(&foreign, &mut authority),
            Err(RenewalRefusal::NotIssued)
        ));
        authority.revoke(&EUCLID, now).unwrap();
        assert!(matches!(
            renew(&ended, &mut authority),
            Err(RenewalRefusal::Revoked)
        ));
        let due = issue(&mut authority, 90 * DAY, now - 80 * DAY);
        renew(&due, &mut authority).unwrap();
        assert!(matches!(
            renew(&due, &mut authority),
            Err(RenewalRefusal::TooSoon)
        ));
        assert!(
            authority.reissue(&due, &key, now).is_ok(),
            "by a person at once"
        );
        authority.revoke(&EUCLID, now).unwrap();
        let reissued = authority.reissue(&due, &key, now);
        assert!(matches!(reissued, Err(RenewalRefusal::Revoked)));
    }
}
