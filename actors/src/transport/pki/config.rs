//! Paths of a node's certificates.

use std::path::PathBuf;

use ecod::config::ConfigError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The files that `ecod-node pki` made for a node, in PEM. They are read again when they change,
/// without a restart.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// The certificate of the cell's CA.
    pub ca: PathBuf,
    /// The node's own certificate; its common name is the node's name.
    pub certificate: PathBuf,
    /// The private key of the certificate. Only the node's user should be able to read it.
    pub key: PathBuf,
    /// The CA's revocation list; default: not set, a certificate is then valid until it expires.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revocation_list: Option<PathBuf>,
    /// The city above the cell; default: not set. The city's CA has signed the cell's CA, and
    /// vehicles that it certifies directly may join every cell of the city.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub city: Option<CityTlsConfig>,
}

/// The files that `ecod-node pki city` made for all cells of a city, in PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CityTlsConfig {
    /// The certificate of the city's CA.
    pub ca: PathBuf,
    /// The city's revocation list, of vehicles and of cells' CAs; needed where the cell has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revocation_list: Option<PathBuf>,
}

impl TlsConfig {
    /// Checks that every path is given; the files are read when the node starts.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let list = self
            .revocation_list
            .as_ref()
            .map(|list| ("revocation_list", list));
        let city = self.city.as_ref();
        let city_list = city
            .and_then(|city| city.revocation_list.as_ref())
            .map(|list| ("city.revocation_list", list));
        let paths = [
            ("ca", &self.ca),
            ("certificate", &self.certificate),
            ("key", &self.key),
        ];
        let city_ca = city.map(|city| ("city.ca", &city.ca));
        for (key, path) in paths
            .into_iter()
            .chain(list)
            .chain(city_ca)
            .chain(city_list)
        {
            if path.as_os_str().is_empty() {
                return Err(ConfigError::missing(key, "the path of a PEM file"));
            }
        }
        // If there is any list, certificates of a CA without a list are refused.
        match (list, city_list) {
            (None, Some(_)) => Err(ConfigError::missing(
                "revocation_list",
                "set together with `city.revocation_list`",
            )),
            (Some(_), None) if city.is_some() => Err(ConfigError::missing(
                "city.revocation_list",
                "set together with `revocation_list`",
            )),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn revocation_lists_come_in_pairs() {
        let read = |cell: &str, city: &str| {
            let text = format!(
                "ca = \"a\"\ncertificate = \"b\"\nkey = \"c\"\n{cell}\n[city]\nca = \"d\"\n{city}"
            );
            toml::from_str::<TlsConfig>(&text)
                .unwrap()
                .validate()
                .map_err(|error| error.key)
        };
        let list = "revocation_list = \"e\"";
        assert_eq!([read("", ""), read(list, list)], [Ok(()), Ok(())]);
        assert_eq!(read(list, "").unwrap_err(), "city.revocation_list");
        assert_eq!(read("", list).unwrap_err(), "revocation_list");
    }
}
