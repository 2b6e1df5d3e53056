//! HTTP for pages: access control, rates of requests, and limits of connections.

pub(crate) mod access;
pub(crate) mod connection_limit;
mod guard;
mod listener;
mod page_reader;

pub use access::PageAccess;
pub use connection_limit::ConnectionLimit;
pub use guard::{HttpRefusal, PageGuard, with_headers};
pub use listener::{BrowserHost, accept};
pub use page_reader::{PageError, read_page};
