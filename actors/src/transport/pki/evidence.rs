//! Signatures of aggregators on their evidence, which other nodes pass on.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use ecod::model::names::NodeName;
use ecod::wire::{LedgerShare, LedgerSignature};
use rustls::pki_types::CertificateDer;
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;

use super::attestation::{began, is_signed_with};
use super::{CertificateSubject, Credentials, LoadedCredentials};

/// Signer and verifier of evidence, with the certificates of one node.
#[derive(Debug)]
pub struct EvidenceSigner {
    cell: NodeName,
    credentials: Arc<Credentials>,
    /// The content of the files that the certificates below were verified with.
    loaded: Arc<LoadedCredentials>,
    /// Verified certificates by their base64; `None` for refused certificates.
    known: BTreeMap<String, Option<Signatory>>,
}

/// The holder of a certificate that the cell's CA has issued and not revoked.
#[derive(Debug, Clone)]
struct Signatory {
    subject: CertificateSubject,
    public_key: Vec<u8>,
}

/// The reason why evidence is not attributed to its aggregator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EvidenceError {
    /// The evidence has no signature.
    #[error("evidence without a signature")]
    Unsigned,
    /// The certificate is not from this cell, revoked, or expired.
    #[error("the certificate beside the evidence is not a valid one of this cell")]
    Certificate,
    /// The certificate belongs to a node other than the aggregator, or to a node that may not lead.
    #[error("evidence signed by another than its aggregator")]
    Signatory,
    /// The signature is of other bytes or by another key.
    #[error("the signature under the evidence is wrong")]
    Signature,
}

/// Maximum number of stored certificates; when it is exceeded, all are verified again.
const MAX_KNOWN: usize = 256;

impl EvidenceSigner {
    /// Signer of the node with these certificates.
    pub fn new(cell: NodeName, credentials: Arc<Credentials>) -> Self {
        let loaded = credentials.current();
        Self {
            cell,
            credentials,
            loaded,
            known: BTreeMap::new(),
        }
    }

    /// Signs a share of the node's own counts. `None` if the system provides no random numbers.
    pub fn sign(&self, share: LedgerShare) -> Option<LedgerShare> {
        let loaded = self.credentials.current();
        let signature = BASE64.encode(loaded.sign(&share.signed_bytes(&self.cell)).ok()?);
        let signed = Some(LedgerSignature {
            certificate: BASE64.encode(loaded.certificate()),
            signature,
        });
        Some(LedgerShare { signed, ..share })
    }

    /// The certificate with which this node signs, in base64.
    pub fn certificate(&self) -> String {
        BASE64.encode(self.loaded.certificate())
    }

    /// True if a certificate belongs to the cell and is not revoked; it may have expired.
    pub fn is_of_cell(&mut self, certificate: &str) -> bool {
        self.known(certificate).is_some()
    }

    /// Reads changed certificates and revocation lists; true if there were any.
    pub fn reload(&mut self) -> bool {
        let loaded = self.credentials.current();
        let has_changed = !Arc::ptr_eq(&loaded, &self.loaded);
        if has_changed {
            self.loaded = loaded;
            self.known.clear();
        }
        has_changed
    }

    /// Verifies a share that was received.
    ///
    /// # Errors
    /// Returns an [`EvidenceError`] unless the share's aggregator signed it, with a valid
    /// certificate of a node that may lead.
    pub fn verify(&mut self, share: &LedgerShare) -> Result<(), EvidenceError> {
        let signatory = self.signatory(share)?;
        // Before the certificate begins, this machine's clock is wrong.
        let since_epoch = SystemTime::now()
            .duration_since(SystemTime::UNIX_EPOCH)
            .unwrap_or_default();
        if Duration::from_micros(signatory.subject.expires().micros()) < since_epoch {
            return Err(EvidenceError::Certificate);
        }
        self.verify_signature(share, &signatory)
    }

    /// Verifies a share that was accepted before: its certificate may have expired since.
    ///
    /// # Errors
    /// Returns an [`EvidenceError`], in particular if the certificate was revoked.
    pub fn verify_again(&mut self, share: &LedgerShare) -> Result<(), EvidenceError> {
        let signatory = self.signatory(share)?;
        self.verify_signature(share, &signatory)
    }

    /// True if the certificate of a verified share still belongs to the cell and is not revoked.
    pub fn is_trusted(&mut self, share: &LedgerShare) -> bool {
        self.signatory(share).is_ok()
    }

    fn verify_signature(
        &self,
        share: &LedgerShare,
        signatory: &Signatory,
    ) -> Result<(), EvidenceError> {
        let signature = share
            .signed
            .as_ref()
            .and_then(|signed| BASE64.decode(&signed.signature).ok())
            .ok_or(EvidenceError::Signature)?;
        let is_signed = is_signed_with(
            &signatory.public_key,
            &share.signed_bytes(&self.cell),
            &signature,
        );
        if is_signed {
            Ok(())
        } else {
            Err(EvidenceError::Signature)
        }
    }

    fn known(&mut self, certificate: &str) -> Option<Signatory> {
        if !self.known.contains_key(certificate) {
            if self.known.len() >= MAX_KNOWN {
                self.known.clear();
            }
            self.known
                .insert(certificate.to_owned(), signatory(certificate, &self.loaded));
        }
        self.known.get(certificate).cloned().flatten()
    }

    /// The aggregator whose counts a share contains, according to the certificate in it.
    fn signatory(&mut self, share: &LedgerShare) -> Result<Signatory, EvidenceError> {
        let certificate = &share
            .signed
            .as_ref()
            .ok_or(EvidenceError::Unsigned)?
            .certificate;
        let signatory = self.known(certificate).ok_or(EvidenceError::Certificate)?;
        let is_aggregator = share
            .lane()
            .is_some_and(|lane| lane.leader == *signatory.subject.name());
        if is_aggregator && signatory.subject.may_serve() {
            Ok(signatory)
        } else {
            Err(EvidenceError::Signatory)
        }
    }
}

/// The holder of a certificate, if the cell's CA issued it and has not revoked it. The caller
/// checks that it has not expired.
fn signatory(certificate: &str, loaded: &LoadedCredentials) -> Option<Signatory> {
    let certificate = CertificateDer::from(BASE64.decode(certificate).ok()?);
    let subject = loaded.subject_of(&certificate).ok()?;
    let (_, parsed) = X509Certificate::from_der(&certificate).ok()?;
    loaded
        .clients
        .verify_client_cert(&certificate, &[], began(&certificate)?)
        .ok()?;
    Some(Signatory {
        subject,
        public_key: parsed.public_key().subject_public_key.data.to_vec(),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use ecod::model::time::Timestamp;
    use ecod::wire::{LedgerEntry, Role, SCHEMA_VERSION};
    use tempfile::TempDir;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::{Authority, TlsConfig};

    const DAY: Duration = Duration::from_secs(86_400);

    fn name(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn signer(
        authority: &mut Authority,
        node: &str,
        role: Role,
        valid: Duration,
        now: Timestamp,
    ) -> EvidenceSigner {
        authority.issue(&name(node), role, valid, now).unwrap();
        let (certificate, key) = authority.files_of(&name(node));
        let ca = authority.ca();
        let list = authority.revocation_list();
        let files = TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city: None,
        };
        EvidenceSigner::new(
            name("lot"),
            Arc::new(Credentials::load(&files, &name(node)).unwrap()),
        )
    }

    fn authority() -> (TempDir, Authority) {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::init(directory.path(), &name("lot"), clock::now()).unwrap();
        (directory, authority)
    }

    fn share(aggregator: &str) -> LedgerShare {
        let aggregator = name(aggregator);
        let node = name("gauss");
        let label = "cup".into();
        LedgerShare {
            schema: SCHEMA_VERSION,
            node: aggregator.clone(),
            epoch: None,
            entries: vec![LedgerEntry {
                epoch: 1,
                aggregator,
                node,
                label,
                correct: 1,
                incorrect: 2,
            }],
            marks: Vec::new(),
            signed: None,
            reset_at_us: None,
        }
    }

    #[test]
    fn evidence_needs_signature_of_aggregator() {
        let (_directory, mut authority) = authority();
        let now = clock::now();
        let mut edge = signer(&mut authority, "edge", Role::Edge, DAY, now);
        let gauss = signer(&mut authority, "gauss", Role::Auto, DAY, now);
        let cav = signer(&mut authority, "cav", Role::Cav, DAY, now);
        let signed = edge.sign(share("edge")).unwrap();
        assert_eq!(edge.verify(&signed), Ok(()));
        let passed_on = LedgerShare {
            node: name("gauss"),
            epoch: Some(7),
            ..signed.clone()
        };
        assert_eq!(edge.verify(&passed_on), Ok(()), "whoever passes it on");

        assert_eq!(edge.verify(&share("edge")), Err(EvidenceError::Unsigned));
        assert_eq!(
            edge.verify(&gauss.sign(share("edge")).unwrap()),
            Err(EvidenceError::Signatory)
        );
        assert_eq!(
            edge.verify(&cav.sign(share("cav")).unwrap()),
            Err(EvidenceError::Signatory)
        );
        let mut changed = signed.clone();
        changed.entries[0].correct = 1_000_000_000;
        assert_eq!(edge.verify(&changed), Err(EvidenceError::Signature));
        let elsewhere = EvidenceSigner::new(name("other"), Arc::clone(&edge.credentials));
        assert_eq!(
            edge.verify(&elsewhere.sign(share("edge")).unwrap()),
            Err(EvidenceError::Signature)
        );
        let mut foreign = super::tests::authority();
        let stranger = signer(&mut foreign.1, "edge", Role::Edge, DAY, now);
        assert_eq!(
            edge.verify(&stranger.sign(share("edge")).unwrap()),
            Err(EvidenceError::Certificate)
        );
        for (certificate, signature) in [("", ""), ("AAAA", "AAAA"), ("?", "?")] {
            let signed = LedgerSignature {
                certificate: certificate.into(),
                signature: signature.into(),
            };
            assert!(
                edge.verify(&LedgerShare {
                    signed: Some(signed),
                    ..share("edge")
                })
                .is_err()
            );
        }
    }

    #[test]
    fn any_changed_bit_breaks_signature() {
        let (_directory, mut authority) = authority();
        let mut edge = signer(&mut authority, "edge", Role::Edge, DAY, clock::now());
        let LedgerSignature {
            certificate,
            signature,
        } = edge.sign(share("edge")).unwrap().signed.unwrap();
        let [der, tag] = [&certificate, &signature].map(|text| BASE64.decode(text).unwrap());
        let flipped = |bytes: &[u8], bit: usize| {
            let mut bytes = bytes.to_vec();
            bytes[bit / 8] ^= 1 << (bit % 8);
            BASE64.encode(bytes)
        };
        for bit in 0..8 * tag.len() {
            let signed = LedgerSignature {
                certificate: certificate.clone(),
                signature: flipped(&tag, bit),
            };
            assert!(
                edge.verify(&LedgerShare {
                    signed: Some(signed),
                    ..share("edge")
                })
                .is_err(),
                "signature, bit {bit}"
            );
        }
        for bit in 0..8 * der.len() {
            let signed = LedgerSignature {
                certificate: flipped(&der, bit),
                signature: signature.clone(),
            };
            assert!(
                edge.verify(&LedgerShare {
                    signed: Some(signed),
                    ..share("edge")
                })
                .is_err(),
                "certificate, bit {bit}"
            );
        }
    }

    #[test]
    fn revocation_removes_evidence_expiry_keeps() {
        let (_directory, mut authority) = authority();
        let now = clock::now();
        let mut edge = signer(&mut authority, "edge", Role::Edge, DAY, now);
        let gauss = signer(&mut authority, "gauss", Role::Auto, DAY, now);
        let old = signer(&mut authority, "old", Role::Auto, DAY, now - 2 * DAY);
        let from_gauss = gauss.sign(share("gauss")).unwrap();
        let from_old = old.sign(share("old")).unwrap();
        assert!(edge.reload() || edge.verify(&from_gauss).is_ok());
        assert_eq!(edge.verify(&from_old), Err(EvidenceError::Certificate));
        assert_eq!(
            edge.verify_again(&from_old),
            Ok(()),
            "what was taken in its time"
        );
        authority.revoke(&name("gauss"), now).unwrap();
        assert_eq!(
            authority.revoke(&name("old"), now).unwrap(),
            1,
            "one that has expired"
        );
        std::thread::sleep(Duration::from_millis(1100));
        assert!(edge.reload());
        for revoked in [&from_gauss, &from_old] {
            assert!(!edge.is_trusted(revoked) && edge.verify_again(revoked).is_err());
        }
        let again = signer(&mut authority, "gauss", Role::Auto, DAY, now);
        std::thread::sleep(Duration::from_millis(1100));
        assert_eq!(
            edge.verify(&again.sign(share("gauss")).unwrap()),
            Ok(()),
            "a new certificate, new evidence"
        );
        assert!(!edge.is_trusted(&from_gauss));
        assert!(fs::exists(authority.revocation_list()).unwrap());
    }
}
