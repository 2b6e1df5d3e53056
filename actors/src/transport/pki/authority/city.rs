//! The CA of a city, above the CAs of its cells.

use std::path::Path;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;

use super::super::attestation::is_issued_by;
use super::{Authority, AuthorityError, CA_DAYS, IssuedCertificate, ca_parameters, days, read};

impl Authority {
    /// Creates a CA for a city, as [`Authority::init`] does for a cell. It certifies vehicles,
    /// which are valid in all cells of the city and cannot lead there, and the CAs of cells.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if there is a CA already or the directory cannot be written.
    pub fn init_city(
        directory: &Path,
        city: &NodeName,
        now: Timestamp,
    ) -> Result<Self, AuthorityError> {
        let parameters = ca_parameters(&format!("ECOD city {city}"), 1, now)?;
        Self::make(directory, city, true, now, |key| {
            Ok(parameters.self_signed(key)?)
        })
    }

    /// Creates a CA for a cell of this city.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if this is not a city, there is a CA already, or a directory
    /// cannot be written.
    pub fn init_cell(
        &mut self,
        directory: &Path,
        cell: &NodeName,
        now: Timestamp,
    ) -> Result<Self, AuthorityError> {
        self.check_is_city(true)?;
        let mut parameters = ca_parameters(&format!("ECOD cell {cell}"), 0, now)?;
        parameters.use_authority_key_identifier_extension = true;
        let serial = parameters
            .serial_number
            .as_ref()
            .map(|serial| hex::encode(serial.as_ref()))
            .unwrap_or_default();
        let issuer = self.issuer()?;
        Self::make(directory, cell, false, now, |key| {
            let expires_at_us = now + days(CA_DAYS);
            let issued = IssuedCertificate {
                node: cell.clone(),
                is_ca: true,
                serial,
                expires_at_us,
                revoked_at_us: None,
            };
            self.record(issued, &issuer, now)?;
            Ok(parameters.signed_by(key, &issuer)?)
        })
    }

    /// Revokes the CAs of a cell, for example if its key was stolen; returns their number.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if there are no such CAs or the list cannot be written.
    pub fn revoke_cell(
        &mut self,
        cell: &NodeName,
        now: Timestamp,
    ) -> Result<usize, AuthorityError> {
        match self.revoke_where(|issued| issued.node == *cell && issued.is_ca, now)? {
            0 => Err(AuthorityError::NotIssued(cell.clone())),
            revoked => Ok(revoked),
        }
    }

    /// True if this is the CA of a cell that a city has signed.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if its certificate cannot be read.
    pub(crate) fn is_of_city(&self) -> Result<bool, AuthorityError> {
        let unusable = |error: &dyn std::fmt::Display| AuthorityError::Crypto(error.to_string());
        let own = CertificateDer::from_pem_slice(read(&self.ca())?.as_bytes())
            .map_err(|error| unusable(&error))?;
        Ok(!is_issued_by(&own, &own))
    }

    /// Checks that this is the CA of a city, or otherwise of a cell.
    ///
    /// # Errors
    /// Returns [`AuthorityError::Kind`].
    pub fn check_is_city(&self, is_city: bool) -> Result<(), AuthorityError> {
        if self.register.is_city == is_city {
            return Ok(());
        }
        let (found, remedy) = if is_city {
            (
                "cell",
                "name the directory that `ecod-node pki city init` made",
            )
        } else {
            (
                "city",
                "use `ecod-node pki city`, or name the directory of a cell",
            )
        };
        Err(AuthorityError::Kind {
            directory: self.directory.clone(),
            found,
            remedy,
        })
    }
}
