//! The certificate authority of a cell or city: a directory on one machine, which need not belong
//! to the cell.

mod city;
mod renewal;

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};
use std::{fs, io};

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use rcgen::{
    BasicConstraints, Certificate, CertificateParams, CertificateRevocationListParams, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, PublicKeyData,
    RevocationReason, RevokedCertParams, SerialNumber,
};
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};

use super::subject::rights_uri;
use super::{BROKER_NAME, DOOR_NAME, OBSERVER_MARK, TlsConfig};
pub use renewal::RenewalRefusal;

use crate::platform::bounded_file;
use crate::platform::owner::give;
use crate::platform::state_file::{content, replace_file, with_checksum};

/// Default validity of a node's certificate in days.
pub const DEFAULT_DAYS: u32 = 365;

/// Days for which a CA is valid.
const CA_DAYS: u32 = 3650;

/// Most time by which the validity of a certificate begins in the past, as clocks of the cell may
/// be behind.
const CLOCK_ALLOWANCE: Duration = Duration::from_secs(3600);

/// The CA of one cell, or of a city above cells, and its register of certificates.
#[derive(Debug)]
pub struct Authority {
    directory: PathBuf,
    register: IssuedCertificates,
}

/// Register of all issued certificates, in `issued.json`. The revocation list is made of it.
#[derive(Debug, Serialize, Deserialize)]
struct IssuedCertificates {
    /// Name of the cell or city.
    cell: NodeName,
    #[serde(default, skip_serializing_if = "is_false")]
    is_city: bool,
    revision: u64,
    issued: Vec<IssuedCertificate>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct IssuedCertificate {
    /// The node, or the cell of a CA.
    node: NodeName,
    #[serde(default, skip_serializing_if = "is_false")]
    is_ca: bool,
    serial: String,
    expires_at_us: Timestamp,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    revoked_at_us: Option<Timestamp>,
}

/// An error of the authority; the previous files remain.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityError {
    /// A file could not be read or written.
    #[error("cannot use {path}")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// No CA in the directory.
    #[error("{0} has no CA: make one with `ecod-node pki init`")]
    Missing(PathBuf),
    /// The directory has a CA already, whose certificates would become invalid.
    #[error("{0} has a CA already; a new one needs an empty directory")]
    Exists(PathBuf),
    /// The CA of a cell where a city's CA is needed, or the reverse.
    #[error("{directory} has the CA of a {found}: {remedy}")]
    Kind {
        /// Directory of the CA.
        directory: PathBuf,
        /// `cell` or `city`.
        found: &'static str,
        /// Advice to the operator, as an imperative phrase.
        remedy: &'static str,
    },
    /// The register cannot be read.
    #[error("{path} cannot be used: {reason}; put a copy of it back")]
    Register {
        /// Path of the file.
        path: PathBuf,
        /// Reason why the register cannot be read.
        reason: String,
    },
    /// The name contains the mark of observers.
    #[error("{0} cannot have a certificate: names of nodes have no `{OBSERVER_MARK}`")]
    Name(NodeName),
    /// The node has no valid certificate.
    #[error("{0} has no certificate that could be revoked")]
    NotIssued(NodeName),
    /// A key or certificate could not be made.
    #[error("no certificate could be made: {0}")]
    Crypto(String),
}

impl From<rcgen::Error> for AuthorityError {
    fn from(error: rcgen::Error) -> Self {
        Self::Crypto(error.to_string())
    }
}

impl Authority {
    /// Makes a CA for a cell in a directory, which is made too, with an empty revocation list.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if there is a CA or the directory cannot be written.
    pub fn init(directory: &Path, cell: &NodeName, now: Timestamp) -> Result<Self, AuthorityError> {
        let parameters = ca_parameters(&format!("ECOD cell {cell}"), 0, now)?;
        Self::make(directory, cell, false, now, |key| {
            Ok(parameters.self_signed(key)?)
        })
    }

    /// Makes a CA whose certificate is signed by `certify`.
    fn make(
        directory: &Path,
        name: &NodeName,
        is_city: bool,
        now: Timestamp,
        certify: impl FnOnce(&KeyPair) -> Result<Certificate, AuthorityError>,
    ) -> Result<Self, AuthorityError> {
        let file = |path: &Path, source| AuthorityError::File {
            path: path.into(),
            source,
        };
        fs::create_dir_all(directory.join(NODES)).map_err(|source| file(directory, source))?;
        if directory.join(CA_KEY).exists() {
            return Err(AuthorityError::Exists(directory.into()));
        }
        let key = KeyPair::generate()?;
        let certificate = certify(&key)?;
        let secret = key.serialize_pem();
        write(&directory.join(CA), &certificate.pem())?;
        let register = IssuedCertificates {
            cell: name.clone(),
            is_city,
            revision: 0,
            issued: Vec::new(),
        };
        let mut authority = Self {
            directory: directory.into(),
            register,
        };
        authority.save(&Issuer::from_ca_cert_pem(&certificate.pem(), key)?, now)?;
        // Last: the key makes a CA complete. An attempt that failed before it can be repeated.
        write_secret(&directory.join(CA_KEY), &secret)?;
        Ok(authority)
    }

    /// Opens the CA of a directory.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if there is no CA.
    pub fn open(directory: &Path) -> Result<Self, AuthorityError> {
        Ok(Self {
            directory: directory.into(),
            register: read_register(directory)?,
        })
    }

    /// Lock of the directory for a change, with the register as it is now: another command may have
    /// changed it.
    fn lock(&mut self) -> Result<File, AuthorityError> {
        let path = self.directory.join(LOCK);
        let opened = match File::open(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                File::create(&path).and_then(|file| keep_owner(&path).map(|()| file))
            }
            opened => opened,
        };
        let locked = opened.and_then(|file| file.lock().map(|()| file));
        let lock = locked.map_err(|source| AuthorityError::File { path, source })?;
        self.register = read_register(&self.directory)?;
        Ok(lock)
    }

    /// Creates a key and a certificate for a node: `nodes/<node>.key` and `nodes/<node>.pem`.
    /// Earlier ones are overwritten, and stay valid until they expire or are revoked. In the
    /// election the node cannot declare more than `rights`.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if the name cannot have a certificate or a file cannot be
    /// written.
    pub fn issue(
        &mut self,
        node: &NodeName,
        rights: impl Into<Rights>,
        valid: Duration,
        now: Timestamp,
    ) -> Result<(), AuthorityError> {
        let key = KeyPair::generate()?;
        let (certificate, _serial) = self.certify(node, rights, valid, now, &key)?;
        let nodes = self.directory.join(NODES);
        write_secret(&nodes.join(format!("{node}.key")), &key.serialize_pem())?;
        write(&nodes.join(format!("{node}.pem")), &certificate)
    }

    /// Certificate in PEM for a key that stays with the node, with the same rights as
    /// [`Authority::issue`], and its serial number in hexadecimal digits.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if the name cannot have one or a file cannot be written.
    pub(crate) fn certify(
        &mut self,
        node: &NodeName,
        rights: impl Into<Rights>,
        valid: Duration,
        now: Timestamp,
        key: &impl PublicKeyData,
    ) -> Result<(String, String), AuthorityError> {
        check_name(node)?;
        let mut parameters = CertificateParams::default();
        parameters
            .distinguished_name
            .push(DnType::CommonName, node.as_str());
        parameters.use_authority_key_identifier_extension = true;
        parameters.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        parameters.extended_key_usages = vec![
            ExtendedKeyUsagePurpose::ClientAuth,
            ExtendedKeyUsagePurpose::ServerAuth,
        ];
        let may_lead = |rights: &Rights| rights.may_lead() && !self.register.is_city;
        let rights = Some(rights.into()).filter(may_lead).unwrap_or(Rights::NONE);
        parameters
            .subject_alt_names
            .push(rcgen::SanType::URI(rights_uri(rights).try_into()?));
        if rights.may_lead() {
            parameters
                .subject_alt_names
                .push(rcgen::SanType::DnsName(BROKER_NAME.try_into()?));
        }
        parameters
            .subject_alt_names
            .push(rcgen::SanType::DnsName(DOOR_NAME.try_into()?));
        set_validity(&mut parameters, now, valid);
        let serial_number = draw_serial()?;
        parameters.serial_number = Some(serial_number.clone());
        let issuer = self.issuer()?;
        let certificate = parameters.signed_by(key, &issuer)?;
        let serial = hex::encode(serial_number.as_ref());
        let issued = IssuedCertificate {
            node: node.clone(),
            is_ca: false,
            serial: serial.clone(),
            expires_at_us: now + valid,
            revoked_at_us: None,
        };
        self.record(issued, &issuer, now)?;
        Ok((certificate.pem(), serial))
    }

    /// Registers a certificate before anyone has it, so that every valid certificate can be
    /// revoked.
    fn record(
        &mut self,
        issued: IssuedCertificate,
        issuer: &Issuer<'_, KeyPair>,
        now: Timestamp,
    ) -> Result<(), AuthorityError> {
        let _lock = self.lock()?;
        self.register.issued.push(issued);
        self.save(issuer, now)
    }

    /// Name of the cell or city.
    pub fn cell(&self) -> &NodeName {
        &self.register.cell
    }

    /// True if a node has a certificate that is valid: not revoked and not expired.
    pub(crate) fn has_certificate(&self, node: &NodeName, now: Timestamp) -> bool {
        let is_valid = |issued: &IssuedCertificate| {
            issued.revoked_at_us.is_none() && issued.expires_at_us > now
        };
        self.register
            .issued
            .iter()
            .any(|issued| issued.node == *node && is_valid(issued))
    }

    /// Revokes all certificates of a node, including expired ones, and rewrites the revocation
    /// list; returns their number. Evidence that was signed while a certificate was valid counts
    /// after its expiry, until it is revoked.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if there are no certificates or the list cannot be written.
    pub fn revoke(&mut self, node: &NodeName, now: Timestamp) -> Result<usize, AuthorityError> {
        match self.revoke_where(|issued| issued.node == *node && !issued.is_ca, now)? {
            0 => Err(AuthorityError::NotIssued(node.clone())),
            revoked => Ok(revoked),
        }
    }

    /// Revokes one certificate, unless it is revoked already.
    pub(crate) fn revoke_serial(
        &mut self,
        serial: &str,
        now: Timestamp,
    ) -> Result<(), AuthorityError> {
        self.revoke_where(|issued| issued.serial == serial, now)
            .map(drop)
    }

    fn revoke_where(
        &mut self,
        is_meant: impl Fn(&IssuedCertificate) -> bool,
        now: Timestamp,
    ) -> Result<usize, AuthorityError> {
        let _lock = self.lock()?;
        let mut revoked = 0;
        let issued = self
            .register
            .issued
            .iter_mut()
            .filter(|issued| issued.revoked_at_us.is_none());
        for issued in issued.filter(|issued| is_meant(issued)) {
            issued.revoked_at_us = Some(now);
            revoked += 1;
        }
        if revoked > 0 {
            self.save(&self.issuer()?, now)?;
        }
        Ok(revoked)
    }

    /// True if a directory has the key of a CA.
    pub(crate) fn has_key(directory: &Path) -> bool {
        directory.join(CA_KEY).exists()
    }

    /// Path of the CA's certificate in PEM.
    pub fn ca(&self) -> PathBuf {
        self.directory.join(CA)
    }

    /// Path of the CA's revocation list in PEM.
    pub fn revocation_list(&self) -> PathBuf {
        self.directory.join(LIST)
    }

    /// Paths of a node's certificate and key, issued or not.
    pub fn files_of(&self, node: &NodeName) -> (PathBuf, PathBuf) {
        let nodes = self.directory.join(NODES);
        (
            nodes.join(format!("{node}.pem")),
            nodes.join(format!("{node}.key")),
        )
    }

    /// The files that a node of the cell needs, issued or not.
    pub fn tls_of(&self, node: &NodeName) -> TlsConfig {
        let (certificate, key) = self.files_of(node);
        TlsConfig {
            ca: self.ca(),
            certificate,
            key,
            revocation_list: Some(self.revocation_list()),
            city: None,
        }
    }

    fn issuer(&self) -> Result<Issuer<'static, KeyPair>, AuthorityError> {
        let key = KeyPair::from_pem(&read(&self.directory.join(CA_KEY))?)?;
        Ok(Issuer::from_ca_cert_pem(&read(&self.ca())?, key)?)
    }

    /// Writes the revocation list and then the register.
    fn save(&mut self, issuer: &Issuer<'_, KeyPair>, now: Timestamp) -> Result<(), AuthorityError> {
        self.register.revision += 1;
        let revoked = |issued: &IssuedCertificate| {
            let serial = SerialNumber::from_slice(&hex::decode(&issued.serial).unwrap_or_default());
            let revocation_time = time(issued.revoked_at_us?).into();
            let reason_code = Some(RevocationReason::PrivilegeWithdrawn);
            Some(RevokedCertParams {
                serial_number: serial,
                revocation_time,
                reason_code,
                invalidity_date: None,
            })
        };
        let list = CertificateRevocationListParams {
            this_update: time(now).into(),
            next_update: time(now + days(CA_DAYS)).into(),
            crl_number: SerialNumber::from(self.register.revision),
            issuing_distribution_point: None,
            revoked_certs: self.register.issued.iter().filter_map(revoked).collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        write(&self.revocation_list(), &list.signed_by(issuer)?.pem()?)?;
        let text = serde_json::to_string_pretty(&self.register).map_err(|error| {
            AuthorityError::Register {
                path: REGISTER.into(),
                reason: error.to_string(),
            }
        })?;
        replace(
            &self.directory.join(REGISTER),
            &with_checksum((text + "\n").as_bytes()),
            0o644,
        )
    }
}

/// Checks that a node may have a certificate under the name.
///
/// # Errors
/// Returns [`AuthorityError::Name`] if the name belongs to an observer.
pub(crate) fn check_name(node: &NodeName) -> Result<(), AuthorityError> {
    if node.as_str().contains(OBSERVER_MARK) {
        Err(AuthorityError::Name(node.clone()))
    } else {
        Ok(())
    }
}

const CA: &str = "ca.pem";
const CA_KEY: &str = "ca.key";
const LIST: &str = "revoked.pem";
const REGISTER: &str = "issued.json";
const LOCK: &str = "issued.lock";
const NODES: &str = "nodes";

fn read_register(directory: &Path) -> Result<IssuedCertificates, AuthorityError> {
    let path = directory.join(REGISTER);
    if !path.exists() {
        return Err(AuthorityError::Missing(directory.into()));
    }
    let text = read(&path)?;
    let register = content(text.as_bytes())
        .and_then(|register| serde_json::from_slice(register).map_err(|error| error.to_string()));
    register.map_err(|reason| AuthorityError::Register { path, reason })
}

/// Parameters of a CA's certificate with a maximum number of CAs below it in a chain.
fn ca_parameters(
    name: &str,
    below: u8,
    now: Timestamp,
) -> Result<CertificateParams, AuthorityError> {
    let mut parameters = CertificateParams::default();
    parameters.distinguished_name.push(DnType::CommonName, name);
    parameters.is_ca = IsCa::Ca(BasicConstraints::Constrained(below));
    parameters.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    set_validity(&mut parameters, now, days(CA_DAYS));
    parameters.serial_number = Some(draw_serial()?);
    Ok(parameters)
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes references")]
fn is_false(value: &bool) -> bool {
    !value
}

fn days(count: u32) -> Duration {
    Duration::from_secs(u64::from(count) * 86_400)
}

fn time(timestamp: Timestamp) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_micros(timestamp.micros())
}

fn set_validity(parameters: &mut CertificateParams, now: Timestamp, valid: Duration) {
    parameters.not_before = (time(now) - clock_allowance(valid)).into();
    parameters.not_after = time(now + valid).into();
}

/// Time by which a validity begins in the past: a small part of a short one.
fn clock_allowance(valid: Duration) -> Duration {
    CLOCK_ALLOWANCE.min(valid / 10)
}

/// A random serial number of 127 bits, which is positive.
fn draw_serial() -> Result<SerialNumber, AuthorityError> {
    let mut bytes = [0; 16];
    let drawn = SystemRandom::new().fill(&mut bytes);
    drawn.map_err(|_| AuthorityError::Crypto("the system gives no random numbers".into()))?;
    bytes[0] = bytes[0] & 0x7f | 0x40;
    Ok(SerialNumber::from_slice(&bytes))
}

fn read(path: &Path) -> Result<String, AuthorityError> {
    bounded_file::read_text(path).map_err(|source| AuthorityError::File {
        path: path.into(),
        source,
    })
}

fn write(path: &Path, text: &str) -> Result<(), AuthorityError> {
    replace(path, text.as_bytes(), 0o644)
}

fn write_secret(path: &Path, text: &str) -> Result<(), AuthorityError> {
    replace(path, text.as_bytes(), 0o600)
}

fn replace(path: &Path, bytes: &[u8], mode: u32) -> Result<(), AuthorityError> {
    let replaced = replace_file(path, bytes, mode).and_then(|()| keep_owner(path));
    replaced.map_err(|source| AuthorityError::File {
        path: path.into(),
        source,
    })
}

/// Gives a new file to the owner of its directory: commands of root and a node that renews
/// certificates use the same CA.
fn keep_owner(path: &Path) -> io::Result<()> {
    let owner = fs::metadata(path.parent().unwrap_or(Path::new(".")))?;
    let file = fs::symlink_metadata(path)?;
    if owner.uid() == file.uid() {
        return Ok(());
    }
    give(path, &owner)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use ecod::wire::Role;

    use super::*;
    use crate::platform::clock;

    #[test]
    fn ca_is_made_once() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        authority
            .issue(
                &NodeName::from_static("edge"),
                Role::Edge,
                days(1),
                clock::now(),
            )
            .unwrap();
        for key in ["ca.key", "nodes/edge.key"] {
            let mode = fs::metadata(directory.path().join(key))
                .unwrap()
                .permissions()
                .mode();
            assert_eq!(mode & 0o777, 0o600, "{key}");
        }
        let again = Authority::init(directory.path(), &cell, clock::now()).unwrap_err();
        assert!(matches!(again, AuthorityError::Exists(_)));
    }

    #[test]
    fn half_made_ca_is_remade() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let obstacle = directory.path().join("issued.tmp");
        fs::create_dir(&obstacle).unwrap();
        Authority::init(directory.path(), &cell, clock::now()).unwrap_err();
        fs::remove_dir(&obstacle).unwrap();
        Authority::init(directory.path(), &cell, clock::now()).unwrap();
        let mut authority = Authority::open(directory.path()).unwrap();
        authority
            .issue(
                &NodeName::from_static("edge"),
                Role::Edge,
                days(1),
                clock::now(),
            )
            .unwrap();
    }

    #[test]
    fn concurrent_commands_lose_no_entries() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let [edge, euclid, gauss] = ["edge", "euclid", "gauss"].map(NodeName::from_static);
        let mut long = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        long.issue(&edge, Role::Edge, days(1), clock::now())
            .unwrap();
        let mut short = Authority::open(directory.path()).unwrap();
        short
            .issue(&euclid, Role::Auto, days(1), clock::now())
            .unwrap();
        short.revoke(&edge, clock::now()).unwrap();
        long.issue(&gauss, Role::Auto, days(1), clock::now())
            .unwrap();
        let mut later = Authority::open(directory.path()).unwrap();
        let revoked = [edge, euclid, gauss].map(|node| later.revoke(&node, clock::now()).ok());
        assert_eq!(
            revoked,
            [None, Some(1), Some(1)],
            "the edge's was revoked before"
        );
    }

    #[test]
    fn altered_register_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        authority
            .issue(
                &NodeName::from_static("edge"),
                Role::Edge,
                days(1),
                clock::now(),
            )
            .unwrap();
        let path = directory.path().join(REGISTER);
        let whole = fs::read(&path).unwrap();
        for place in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[place] ^= 1;
            fs::write(&path, damaged).unwrap();
            assert!(Authority::open(directory.path()).is_err(), "byte {place}");
        }
        fs::write(&path, whole).unwrap();
        Authority::open(directory.path()).unwrap();
    }

    #[test]
    fn issued_certificate_is_revoked_once() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let edge = NodeName::from_static("edge");
        let euclid = NodeName::from_static("euclid");
        Authority::init(directory.path(), &cell, clock::now()).unwrap();
        let mut authority = Authority::open(directory.path()).unwrap();
        for _ in 0..2 {
            authority
                .issue(&edge, Role::Edge, days(1), clock::now())
                .unwrap();
        }
        assert!(matches!(
            authority.revoke(&euclid, clock::now()),
            Err(AuthorityError::NotIssued(_))
        ));
        assert_eq!(authority.revoke(&edge, clock::now()).unwrap(), 2);
        let mut reopened = Authority::open(directory.path()).unwrap();
        assert!(matches!(
            reopened.revoke(&edge, clock::now()),
            Err(AuthorityError::NotIssued(_))
        ));
        let observer = NodeName::from_static("edge--top");
        assert!(matches!(
            reopened.issue(&observer, Role::Cav, days(1), clock::now()),
            Err(AuthorityError::Name(_))
        ));
    }
}
