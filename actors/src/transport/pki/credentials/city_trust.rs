//! Trust of a cell that belongs to a city.
//!
//! Certificates count that the cell's CA or the city's CA has issued itself. Those of other cells do not, although the city
//! has signed their CAs: so a stolen key of a cell lets nobody into another. The city certifies vehicles alone.

use std::path::Path;
use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{DigitallySignedStruct, DistinguishedName, Error, RootCertStore, SignatureScheme};
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;
use x509_parser::revocation_list::CertificateRevocationList;

use super::super::attestation::is_issued_by;
use super::super::config::CityTlsConfig;
use super::{CredentialsError, authorities, file_error, lists};

/// The CAs of the cell that the city has signed and not revoked, with the city's; and those that it has revoked. The city's
/// revocation lists are put to `all`.
///
/// # Errors
/// [`CredentialsError`] naming the file, in particular for a CA of the cell that the city has not signed.
pub(super) fn roots(
    cell: &Path,
    city: &CityTlsConfig,
    all: &mut Vec<CertificateRevocationListDer<'static>>,
) -> Result<(RootCertStore, Vec<CertificateDer<'static>>), CredentialsError> {
    let own = city.revocation_list.as_deref().map(|path| lists("tls.city.revocation_list", path)).transpose()?;
    let own = own.unwrap_or_default();
    let city_cas = authorities("tls.city.ca", &city.ca)?;
    let (mut roots, mut revoked) = (RootCertStore::empty(), Vec::new());
    for certificate in authorities("tls.ca", cell)? {
        let unusable = |reason: &str| file_error("tls.ca", cell, reason);
        let (_, parsed) = X509Certificate::from_der(&certificate).map_err(|_| unusable("not an X.509 certificate"))?;
        if !city_cas.iter().any(|city_ca| is_issued_by(city_ca, &certificate)) {
            let city_ca = city.ca.display();
            return Err(unusable(&format!(
                "{city_ca} has not signed it: make the cell's CA by `ecod-node pki init --city`"
            )));
        }
        if own.iter().any(|list| revokes(list, &parsed)) {
            tracing::error!(cell = %parsed.subject(), "the city has revoked the cell's CA: none of its certificates counts; \
                make a new one by `ecod-node pki init --city`");
            revoked.push(certificate.clone());
        } else {
            roots.add(certificate.clone()).map_err(|error| unusable(&error.to_string()))?;
        }
    }
    for certificate in city_cas {
        roots.add(certificate).map_err(|error| file_error("tls.city.ca", &city.ca, &error))?;
    }
    all.extend(own);
    Ok((roots, revoked))
}

/// True if the issuer of a certificate has revoked it by a list.
fn revokes(list: &[u8], certificate: &X509Certificate<'_>) -> bool {
    let Ok((_, list)) = CertificateRevocationList::from_der(list) else { return false };
    list.issuer() == certificate.issuer()
        && list.iter_revoked_certificates().any(|revoked| revoked.raw_serial() == certificate.raw_serial())
}

/// Verifier of clients' certificates that a CA has issued itself: what else the client sends along leads nowhere.
#[derive(Debug)]
pub(super) struct DirectVerifier(pub(super) Arc<dyn ClientCertVerifier>);

impl ClientCertVerifier for DirectVerifier {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        self.0.root_hint_subjects()
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        self.0.verify_client_cert(end_entity, &[], now)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.0.verify_tls12_signature(message, cert, dss)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.0.verify_tls13_signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.0.supported_verify_schemes()
    }
}

#[cfg(test)]
mod tests;
