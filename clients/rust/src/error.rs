//! Errors that a program can act on.

/// An error of a program's part in a cell. Its text says what failed, where, and the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// Nobody answers as a broker at the address.
    #[error("{0}")]
    Unreachable(String),
    /// The broker refuses the login, a subscription or a report.
    #[error("{0}")]
    Refused(String),
    /// Nothing arrived within the given time.
    #[error("{0}")]
    Silent(String),
    /// A value that the protocol does not allow. Nothing was sent.
    #[error("{0}")]
    Invalid(String),
}
