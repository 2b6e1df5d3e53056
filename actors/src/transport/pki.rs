//! Certificates of a cell, which authenticate nodes at embedded brokers.
//!
//! ```text
//! Authority           a directory with the cell's CA: issues node certificates and the revocation list
//! Credentials         the certificates of one node; reloads changed files
//! CertificateSubject  the node that a certificate names, and its rights
//! BrokerTrust         verification of a broker's certificate for as long as a connection lasts
//! EvidenceSigner      signatures under evidence that is passed on
//! NewKey              a node's next key, and the request for its certificate
//! ```
//!
//! Each cell has its own CA, so that certificates of other cells are not valid in it. A city's CA
//! may stand above: it signs the CAs of cells, and certifies vehicles for all of them. A
//! certificate's common name is the node's name. An alternative name of kind URI holds its highest
//! role and priority. Only the certificate of a node that may lead also has [`BROKER_NAME`], which
//! clients verify: a vehicle that cannot lead cannot pose as a broker, and addresses may change.

mod attestation;
mod authority;
mod broker_trust;
mod config;
mod credentials;
mod evidence;
mod renewal;
mod subject;

pub(crate) use attestation::{Distrust, MAX_CERTIFICATE_BYTES, is_signed_by};
pub(crate) use authority::check_name;
pub use authority::{Authority, AuthorityError, DEFAULT_DAYS, RenewalRefusal};
pub use broker_trust::{BrokerIdentity, BrokerTrust};
pub use config::{CityTlsConfig, TlsConfig};
pub use credentials::{Credentials, CredentialsError, LoadedCredentials, external_broker};
pub use evidence::{EvidenceError, EvidenceSigner};
pub(crate) use renewal::{NewKey, RenewalMessage, renew};
pub use subject::{CertificateSubject, InvalidCertificate};

/// DNS name in the certificate of every node that may lead, below a domain reserved for private
/// use.
pub const BROKER_NAME: &str = "broker.ecod.internal";

/// Name by which programs verify a node's local broker. Nodes do not accept it as a broker's name.
pub const DOOR_NAME: &str = "door.ecod.internal";

/// Scheme of the URI in a node's certificate that holds its rights, such as
/// `ecod:role=auto;priority=100`.
const RIGHTS_SCHEME: &str = "ecod:";

/// Separator between a node's name and the rest in the names of observers that use its certificate.
pub const OBSERVER_MARK: &str = "--";
