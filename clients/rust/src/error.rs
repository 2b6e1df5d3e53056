//! Errors to which a program can react.

/// An error of a program's connection to a cell. Its text names the failed operation, the address,
/// and the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// There is no answer from a broker at the address.
    #[error("{0}")]
    Unreachable(String),
    /// The broker refuses the login, a subscription or a report.
    #[error("{0}")]
    Refused(String),
    /// No message arrived within the given time.
    #[error("{0}")]
    Silent(String),
    /// A value that the protocol does not allow. The message was not sent.
    #[error("{0}")]
    Invalid(String),
}
