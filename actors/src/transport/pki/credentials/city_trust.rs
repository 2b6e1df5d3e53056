//! Trust in a cell that belongs to a city.
//!
//! Certificates are accepted if the cell's CA or the city's CA has issued them directly.
//! Certificates of other cells are refused, although the city has signed their CAs: a stolen key of
//! a cell must not give access to another cell. The city certifies vehicles only: rights and
//! brokers' names in its certificates are ignored.

use std::path::Path;

use rustls::pki_types::{CertificateDer, CertificateRevocationListDer};
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;
use x509_parser::revocation_list::CertificateRevocationList;

use super::super::attestation::{is_issued_by, is_list_of};
use super::super::config::CityTlsConfig;
use super::{CredentialsError, authorities, file_error, lists};

/// CAs of a cell and of its city.
pub(super) struct CityAuthorities {
    /// CAs of the cell that the city has signed and not revoked.
    pub(super) of_cell: Vec<CertificateDer<'static>>,
    /// CAs of the cell that the city has revoked.
    pub(super) revoked: Vec<CertificateDer<'static>>,
    /// Certificates of the city's own CAs.
    pub(super) of_city: Vec<CertificateDer<'static>>,
}

/// Reads the CAs of the cell and of its city. The city's revocation lists are added to `all`.
///
/// # Errors
/// Returns a [`CredentialsError`] that names the file, in particular for a CA of the cell that the
/// city has not signed.
pub(super) fn authorities_of(
    cell: &Path,
    city: &CityTlsConfig,
    all: &mut Vec<CertificateRevocationListDer<'static>>,
) -> Result<CityAuthorities, CredentialsError> {
    let own = city
        .revocation_list
        .as_deref()
        .map(|path| lists("tls.city.revocation_list", path))
        .transpose()?
        .unwrap_or_default();
    let of_city = authorities("tls.city.ca", &city.ca)?;
    let mut of_cell = Vec::new();
    let mut revoked = Vec::new();
    for certificate in authorities("tls.ca", cell)? {
        let Some(signed_by) = of_city
            .iter()
            .find(|city_ca| is_issued_by(city_ca, &certificate))
        else {
            let city_ca = city.ca.display();
            let reason = format!(
                "{city_ca} has not signed it: make the cell's CA by `ecod-node pki init --city`"
            );
            return Err(file_error("tls.ca", cell, &reason));
        };
        if own
            .iter()
            .any(|list| is_list_of(signed_by, list) && lists_serial(list, &certificate))
        {
            tracing::error!(file = %cell.display(), "the city has revoked the cell's CA: none of its certificates counts; \
                make a new one by `ecod-node pki init --city`");
            revoked.push(certificate);
        } else {
            of_cell.push(certificate);
        }
    }
    all.extend(own);
    Ok(CityAuthorities {
        of_cell,
        revoked,
        of_city,
    })
}

/// True if a list has the serial number of a certificate.
fn lists_serial(list: &[u8], certificate: &[u8]) -> bool {
    let (Ok((_, list)), Ok((_, certificate))) = (
        CertificateRevocationList::from_der(list),
        X509Certificate::from_der(certificate),
    ) else {
        return false;
    };
    list.iter_revoked_certificates()
        .any(|revoked| revoked.raw_serial() == certificate.raw_serial())
}

#[cfg(test)]
mod tests;
