//! Replacement of a node's certificate and key on disk.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

use pem::Pem;
use rustls::pki_types::UnixTime;
use x509_parser::certificate::X509Certificate;
use x509_parser::prelude::FromDer;

use super::{Credentials, CredentialsError, file_error};
use crate::platform::bounded_file;
use crate::platform::owner::give;
use crate::platform::state_file::replace_file;

impl Credentials {
    /// Replaces the node's certificate and key by a certificate in DER with the same name and
    /// rights, and its key in PEM. Each file is replaced atomically, and every moment leaves a pair
    /// that [`Credentials::load`] accepts: meanwhile the key file has both keys.
    ///
    /// # Errors
    /// Returns a [`CredentialsError`] if the certificate does not fit, or a file cannot be written.
    pub(crate) fn replace(
        &self,
        certificate: &[u8],
        public_key: &[u8],
        secret: &str,
    ) -> Result<(), CredentialsError> {
        let files = &self.files;
        let current = self.current();
        let unfit = |reason: &dyn std::fmt::Display| {
            CredentialsError::Unusable(format!("the new certificate cannot be used: {reason}"))
        };
        let subject = current
            .verify_node(certificate, UnixTime::now())
            .map_err(|error| unfit(&error))?;
        let (_, parsed) = X509Certificate::from_der(certificate).map_err(|error| unfit(&error))?;
        if subject.name() != current.identity.name()
            || subject.rights() != current.identity.rights()
            || *parsed.public_key().subject_public_key.data != *public_key
        {
            return Err(unfit(&"it has another name, other rights or another key"));
        }
        if subject.expires() <= current.identity.expires() {
            return Err(unfit(&"it ends sooner"));
        }
        let write = |key: &'static str, path: &Path, text: &str| {
            replace_like_before(path, text).map_err(|error| file_error(key, path, &error))
        };
        let former = bounded_file::read_text(&files.key)
            .map_err(|error| file_error("tls.key", &files.key, &error))?;
        write("tls.key", &files.key, &format!("{former}\n{secret}"))?;
        write(
            "tls.certificate",
            &files.certificate,
            &pem::encode(&Pem::new("CERTIFICATE", certificate)),
        )?;
        write("tls.key", &files.key, secret)
    }
}

/// Replaces a file, with its owner and permissions.
fn replace_like_before(path: &Path, text: &str) -> io::Result<()> {
    let former = fs::metadata(path)?;
    replace_file(path, text.as_bytes(), former.permissions().mode())?;
    if fs::symlink_metadata(path)?.uid() == former.uid() {
        return Ok(());
    }
    give(path, &former)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::model::names::NodeName;
    use ecod::wire::Role;
    use rustls::pki_types::CertificateDer;
    use rustls::pki_types::pem::PemObject;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::{Authority, NewKey, TlsConfig};

    const DAY: Duration = Duration::from_secs(86_400);
    const EUCLID: NodeName = NodeName::from_static("euclid");

    struct Machine {
        _directory: tempfile::TempDir,
        authority: Authority,
        files: TlsConfig,
    }

    /// The files of a candidate with one day left.
    fn machine() -> Machine {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot");
        let mut authority = Authority::init(directory.path(), &cell, clock::wall()).unwrap();
        let issued_at = clock::wall() - 9 * DAY;
        authority
            .issue(&EUCLID, Role::Auto, 10 * DAY, issued_at)
            .unwrap();
        let files = authority.tls_of(&EUCLID);
        Machine {
            _directory: directory,
            authority,
            files,
        }
    }

    #[test]
    fn power_loss_keeps_matching_key() {
        let Machine {
            mut authority,
            files,
            _directory,
        } = machine();
        let read = |path: &Path| fs::read_to_string(path).unwrap();
        let old = read(&files.certificate);
        let old_key = read(&files.key);
        let credentials = Credentials::load(&files, &EUCLID).unwrap();
        let new_key = NewKey::generate().unwrap();
        new_key.reissue(&mut authority, &credentials).unwrap();
        let new = read(&files.certificate);
        let key = read(&files.key);
        assert!(new != old && key != old_key && !key.contains(&old_key));
        let both = format!("{old_key}\n{key}");
        for (certificate, key) in [(&old, &both), (&new, &both), (&new, &key)] {
            fs::write(&files.certificate, certificate).unwrap();
            fs::write(&files.key, key).unwrap();
            Credentials::load(&files, &EUCLID).unwrap();
        }
    }

    #[test]
    fn mismatching_certificate_is_not_installed() {
        let Machine {
            mut authority,
            files,
            _directory,
        } = machine();
        let credentials = Credentials::load(&files, &EUCLID).unwrap();
        let before = fs::read(&files.certificate).unwrap();
        let key = NewKey::generate().unwrap();
        let other = NodeName::from_static("gauss");
        for (name, role) in [
            (&EUCLID, Role::Auto),
            (&EUCLID, Role::Edge),
            (&other, Role::Auto),
        ] {
            let elsewhere = tempfile::tempdir().unwrap();
            let kept = elsewhere.path().join("kept");
            fs::copy(&files.key, &kept).unwrap();
            authority
                .issue(name, role, 10 * DAY, clock::wall())
                .unwrap();
            let (certificate, _) = authority.files_of(name);
            let foreign = CertificateDer::from_pem_file(&certificate).unwrap();
            fs::write(&files.certificate, &before).unwrap();
            fs::copy(&kept, &files.key).unwrap();
            let refused = key.install(&foreign, &credentials).unwrap_err().to_string();
            assert!(
                refused.contains("another name, other rights or another key"),
                "{refused}"
            );
        }
        assert_eq!(fs::read(&files.certificate).unwrap(), before);
        Credentials::load(&files, &EUCLID).unwrap();
    }
}
