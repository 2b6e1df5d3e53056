//! Certificates of a cell: who is who at an embedded broker.
//!
//! ```text
//! Authority   a directory with the cell's CA: makes node certificates and the revocation list
//! Credentials what one node holds of it: checks others, shows itself, notices changed files
//! Identity    what a certificate says of its holder
//! BrokerTrust whether a broker's certificate is good, for as long as a connection lasts
//! ```
//!
//! A cell has a CA of its own, so that a certificate of another cell is worth nothing here. A certificate's common name
//! is the node's name. One for a node that may lead also bears [`BROKER_NAME`], which is what clients look for: a
//! vehicle that never leads cannot pose as a broker, and addresses may change.

mod authority;
mod broker_trust;
mod config;
mod credentials;
mod subject;

pub use authority::{Authority, AuthorityError, DEFAULT_DAYS};
pub use broker_trust::BrokerTrust;
pub use config::TlsConfig;
pub use credentials::{Credentials, CredentialsError, LoadedCredentials, external_broker};
pub use subject::{CertificateSubject, InvalidCertificate};

/// The DNS name in the certificate of every node that may lead, below a domain that is reserved for private use.
pub const BROKER_NAME: &str = "broker.ecod.internal";

/// What stands between a node's name and the rest in names of observers that use the node's certificate.
pub const OBSERVER_MARK: &str = "--";
