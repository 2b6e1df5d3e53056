//! The CAs that certify nodes of a cell.
//!
//! Certificates are accepted if one of these CAs has issued them directly; intermediate
//! certificates sent by a peer are ignored. Each CA is verified with its own key and its own
//! revocation list, so that CAs with equal names, such as a cell's former and current CA, are not
//! confused.

use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, ServerName, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, RootCertStore,
    SignatureScheme,
};

use super::super::attestation::{is_issued_by, is_list_of};
use super::super::subject::Validity;
use super::{CredentialsError, crypto};

/// The CAs of a cell, and the CAs of the city above it. Verifies clients' certificates.
#[derive(Debug)]
pub(in super::super) struct Issuers {
    of_cell: Vec<Issuer>,
    /// `None` for a cell that stands alone.
    of_city: Option<Vec<Issuer>>,
    names: Vec<DistinguishedName>,
}

/// A CA and the verifiers of its certificates.
#[derive(Debug)]
struct Issuer {
    certificate: CertificateDer<'static>,
    clients: Arc<dyn ClientCertVerifier>,
    servers: Arc<WebPkiServerVerifier>,
}

/// Verifier of the certificates of nodes that serve.
#[derive(Debug)]
pub(super) struct ServingNodes {
    issuers: Arc<Issuers>,
    /// True if the city's vehicles count, too.
    with_vehicles: bool,
}

impl Issuers {
    /// CAs with their lists. While there is any list, certificates of a CA without one are refused.
    ///
    /// # Errors
    /// Returns [`CredentialsError::Unusable`] for a CA or list that cannot be used.
    pub(super) fn new(
        of_cell: Vec<CertificateDer<'static>>,
        of_city: Option<Vec<CertificateDer<'static>>>,
        lists: &[CertificateRevocationListDer<'static>],
    ) -> Result<Self, CredentialsError> {
        let issuers = |cas: Vec<CertificateDer<'static>>| {
            cas.into_iter().map(|ca| Issuer::new(ca, lists)).collect()
        };
        let of_cell: Vec<Issuer> = issuers(of_cell)?;
        let of_city: Option<Vec<Issuer>> = of_city.map(issuers).transpose()?;
        let all = of_cell.iter().chain(of_city.iter().flatten());
        let names = all
            .flat_map(|issuer| issuer.clients.root_hint_subjects().to_vec())
            .collect();
        Ok(Self {
            of_cell,
            of_city,
            names,
        })
    }

    /// True if a certificate may give rights: a city's certificates do not, because a city
    /// certifies only vehicles.
    pub(super) fn give_rights(&self, certificate: &[u8]) -> bool {
        self.of_city.is_none()
            || self
                .of_cell
                .iter()
                .any(|issuer| is_issued_by(&issuer.certificate, certificate))
    }

    /// Validity of the CA that has issued a certificate; unlimited if it is unknown.
    pub(super) fn validity_of_issuer(&self, certificate: &[u8]) -> Validity {
        let issuer = self
            .all()
            .find(|issuer| is_issued_by(&issuer.certificate, certificate));
        issuer
            .and_then(|issuer| Validity::of(&issuer.certificate))
            .unwrap_or(Validity::UNLIMITED)
    }

    fn all(&self) -> impl Iterator<Item = &Issuer> {
        self.of_cell.iter().chain(self.of_city.iter().flatten())
    }
}

impl Issuer {
    fn new(
        certificate: CertificateDer<'static>,
        lists: &[CertificateRevocationListDer<'static>],
    ) -> Result<Self, CredentialsError> {
        let unusable =
            |error: &dyn std::fmt::Display| CredentialsError::Unusable(error.to_string());
        let mut roots = RootCertStore::empty();
        roots
            .add(certificate.clone())
            .map_err(|error| unusable(&error))?;
        let roots = Arc::new(roots);
        let own: Vec<_> = lists
            .iter()
            .filter(|list| is_list_of(&certificate, list))
            .cloned()
            .collect();
        // With other CAs' lists, the status of this CA's certificates would be unknown.
        let lists = if own.is_empty() { lists.to_vec() } else { own };
        let mut client_builder =
            WebPkiClientVerifier::builder_with_provider(Arc::clone(&roots), crypto());
        let mut server_builder = WebPkiServerVerifier::builder_with_provider(roots, crypto());
        if !lists.is_empty() {
            client_builder = client_builder
                .with_crls(lists.iter().cloned())
                .only_check_end_entity_revocation();
            server_builder = server_builder
                .with_crls(lists)
                .only_check_end_entity_revocation();
        }
        let clients = client_builder.build().map_err(|error| unusable(&error))?;
        let servers = server_builder.build().map_err(|error| unusable(&error))?;
        Ok(Self {
            certificate,
            clients,
            servers,
        })
    }
}

/// Verifies by each issuer in turn. Returns the error of the issuer that issued the certificate.
fn verify_by<'a, T>(
    issuers: impl Iterator<Item = &'a Issuer>,
    verify: impl Fn(&Issuer) -> Result<T, Error>,
) -> Result<T, Error> {
    let mut failure = Error::InvalidCertificate(CertificateError::UnknownIssuer);
    for issuer in issuers {
        match verify(issuer) {
            Ok(verified) => return Ok(verified),
            Err(Error::InvalidCertificate(
                CertificateError::UnknownIssuer | CertificateError::BadSignature,
            )) => {}
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

impl ClientCertVerifier for Issuers {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &self.names
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        verify_by(self.all(), |issuer| {
            issuer.clients.verify_client_cert(end_entity, &[], now)
        })
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12_signature(
            message,
            cert,
            dss,
            &crypto().signature_verification_algorithms,
        )
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(
            message,
            cert,
            dss,
            &crypto().signature_verification_algorithms,
        )
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        crypto()
            .signature_verification_algorithms
            .supported_schemes()
    }
}

impl ServingNodes {
    /// Verifier of brokers, which only the cell certifies.
    pub(super) fn brokers(issuers: &Arc<Issuers>) -> Arc<dyn ServerCertVerifier> {
        Arc::new(Self {
            issuers: Arc::clone(issuers),
            with_vehicles: false,
        })
    }

    /// Verifier of local brokers, which vehicles of the city have, too.
    pub(super) fn doors(issuers: &Arc<Issuers>) -> Arc<dyn ServerCertVerifier> {
        Arc::new(Self {
            issuers: Arc::clone(issuers),
            with_vehicles: true,
        })
    }
}

impl ServerCertVerifier for ServingNodes {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let cities = self
            .issuers
            .of_city
            .iter()
            .flatten()
            .filter(|_| self.with_vehicles);
        verify_by(self.issuers.of_cell.iter().chain(cities), |issuer| {
            issuer
                .servers
                .verify_server_cert(end_entity, &[], name, ocsp_response, now)
        })
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.issuers.verify_tls12_signature(message, cert, dss)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.issuers.verify_tls13_signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.issuers.supported_verify_schemes()
    }
}
