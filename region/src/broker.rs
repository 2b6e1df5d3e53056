//! Address of a region's broker, and the login there.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use clap::Args;
use ecod::leadership::BrokerAddress;
use ecod_actors::platform::bounded_file;
use ecod_actors::platform::secret::Secret;
use rumqttc::{MqttOptions, TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use rustls::{ClientConfig, RootCertStore};
use uuid::Uuid;

/// The broker of a region, on the command line.
#[derive(Debug, Clone, Args)]
pub struct BrokerArguments {
    /// The region's broker
    #[arg(long, value_name = "HOST:PORT")]
    pub broker: BrokerAddress,
    /// PEM file with the CAs of the broker's certificate; without it the connection is plaintext
    #[arg(long, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// User name
    #[arg(long, requires = "password_file")]
    pub user: Option<String>,
    /// File with the password
    #[arg(long, value_name = "FILE", requires = "user")]
    pub password_file: Option<PathBuf>,
}

/// Address, certificates and login.
#[derive(Debug, Clone)]
pub struct BrokerLogin {
    address: BrokerAddress,
    tls: Option<Arc<ClientConfig>>,
    login: Option<(String, Secret)>,
}

/// Silence after which the broker is pinged.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

/// Largest packet in bytes. A larger one cuts the connection.
const MAX_PACKET_BYTES: usize = 8 << 20;

impl BrokerArguments {
    /// Reads all files of the login.
    ///
    /// # Errors
    /// Returns an error if a file cannot be read or lacks the expected content.
    pub fn load(&self) -> anyhow::Result<BrokerLogin> {
        let password = self.password_file.as_deref().map(read_secret).transpose()?;
        let tls = self.ca.as_deref().map(trust).transpose()?;
        Ok(BrokerLogin {
            address: self.broker.clone(),
            tls,
            login: self.user.clone().zip(password),
        })
    }
}

impl BrokerLogin {
    /// A plaintext connection without a login.
    pub fn anonymous(address: BrokerAddress) -> Self {
        Self {
            address,
            tls: None,
            login: None,
        }
    }

    /// A plaintext login by user and password.
    pub fn plain(address: BrokerAddress, user: &str, password: &str) -> Self {
        Self {
            address,
            tls: None,
            login: Some((user.to_owned(), Secret::new(password))),
        }
    }

    /// Options of a connection. The client id is random, because a client with the same id could
    /// end this connection.
    pub fn options(&self) -> MqttOptions {
        let stated_host = self.address.host();
        // The name in the certificate has no brackets.
        let host = if self.tls.is_some() {
            stated_host.trim_matches(['[', ']'])
        } else {
            stated_host
        };
        let id = format!("ecod-region-{}", Uuid::new_v4().simple());
        let mut options = MqttOptions::new(id, host, self.address.port());
        options.set_keep_alive(KEEP_ALIVE);
        options.set_max_packet_size(MAX_PACKET_BYTES, MAX_PACKET_BYTES);
        if let Some((user, password)) = &self.login {
            options.set_credentials(user, password.reveal());
        }
        if let Some(tls) = &self.tls {
            options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(
                Arc::clone(tls),
            )));
        }
        options
    }

    /// The address, as messages name it.
    pub fn address(&self) -> &BrokerAddress {
        &self.address
    }
}

/// The first line of a file.
///
/// # Errors
/// Returns an error if it cannot be read or is empty.
pub fn read_secret(path: &Path) -> anyhow::Result<Secret> {
    let text =
        bounded_file::read_text(path).with_context(|| format!("cannot read {}", path.display()))?;
    let line = text.lines().next().unwrap_or_default().trim();
    ensure!(
        !line.is_empty(),
        "{} is empty: its first line is to be the secret",
        path.display()
    );
    Ok(Secret::new(line))
}

fn trust(ca: &Path) -> anyhow::Result<Arc<ClientConfig>> {
    let named = || format!("cannot use the CAs of {}", ca.display());
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_file_iter(ca).with_context(named)? {
        roots
            .add(certificate.with_context(named)?)
            .with_context(named)?;
    }
    ensure!(!roots.is_empty(), "{} has no certificate", ca.display());
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder =
        ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
    Ok(Arc::new(
        builder.with_root_certificates(roots).with_no_client_auth(),
    ))
}
