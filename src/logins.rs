//! Logins in texts that are shown, such as errors about addresses.

use std::net::SocketAddr;

/// Placeholder printed instead of a secret.
pub const HIDDEN: &str = "***";

/// A value that should be an address, as errors show it: without the login.
pub fn without_login(address: &str) -> String {
    match address.rsplit_once('@') {
        Some((_, host)) => format!("{HIDDEN}@{host}"),
        None => without_logins(address),
    }
}

/// A text without logins and queries of addresses in it. An address whose login has no certain end,
/// for example because of a `/` in the password, is hidden as a whole.
pub fn without_logins(text: &str) -> String {
    text.split('\n')
        .map(line_without_logins)
        .collect::<Vec<_>>()
        .join("\n")
}

fn line_without_logins(line: &str) -> String {
    let mut shown = String::new();
    let mut rest = line;
    while let Some((before, address)) = rest.split_once(SCHEME_END) {
        shown.push_str(&without_bare_logins(before));
        shown.push_str(SCHEME_END);
        let is_of_scheme = |c: char| c.is_ascii_alphanumeric() || matches!(c, '+' | '-' | '.');
        let begin = before.trim_end_matches(is_of_scheme).chars().next_back();
        let quote = begin.filter(|c| matches!(c, '"' | '\'' | '`'));
        let token = match quote {
            Some(quote) => address.split(quote).next(),
            None => address
                .split(char::is_whitespace)
                .next()
                // Punctuation of the sentence around the address.
                .map(|token| token.trim_end_matches([':', ';', ',', '.', ')', '"', '\''])),
        };
        let (address, after) = address.split_at(token.map_or(address.len(), str::len));
        // A login may go on behind a blank or a quote.
        let before_next = after.split(SCHEME_END).next().unwrap_or(after);
        let is_half = if quote.is_none() {
            before_next.contains('@') || (!address.contains('@') && may_be_half_a_login(address))
        } else {
            (!address.contains('@') || before_next.contains('@')) && may_be_half_a_login(address)
        };
        if is_half {
            shown.push_str(HIDDEN);
            rest = "";
        } else {
            shown.push_str(bare_address(address).unwrap_or(HIDDEN));
            rest = after;
        }
    }
    shown + &without_bare_logins(rest)
}

/// A text whose addresses have no scheme, such as `user:password@broker:1883`, without their logins.
/// A blank in a password does not end the login, so the text from the first `user:` to the last `@`
/// is hidden.
fn without_bare_logins(text: &str) -> String {
    const HIDDEN_LOGIN: &str = "***@";
    let parts = text.split(HIDDEN_LOGIN).map(without_bare_login);
    parts.collect::<Vec<_>>().join(HIDDEN_LOGIN)
}

fn without_bare_login(text: &str) -> String {
    let hidden = text.rsplit_once('@').and_then(|(before, host)| {
        let is_user = |word: &&str| {
            let word = word.trim_end_matches([':', ';', ',', '.', ')']);
            word.contains(':') && word.parse::<SocketAddr>().is_err()
        };
        let word = before.split_whitespace().find(is_user)?;
        let (sentence, _) = before.split_once(word)?;
        let (user, _) = word.split_once(':')?;
        // A quote of the sentence, or the name of an option, before the user.
        let is_of_user = |c: char| !matches!(c, '"' | '\'' | '`' | '=' | '(' | '[' | '{');
        let option = user.trim_end_matches(is_of_user);
        Some(format!("{sentence}{option}{HIDDEN}@{host}"))
    });
    hidden.unwrap_or_else(|| text.to_owned())
}

const SCHEME_END: &str = "://";

/// An address, after its scheme, without login and query; `None` if it is not certain where the
/// login ends.
pub fn bare_address(address: &str) -> Option<&str> {
    let is_end = |c: char| matches!(c, '/' | '?' | '#' | '"' | '\'' | '\\') || c.is_whitespace();
    let authority = address.split(is_end).next().unwrap_or(address);
    let login = authority.rfind('@').map_or(0, |at| at + 1);
    let (_, bare) = address.split_at(login);
    if bare.contains('@') || may_be_half_a_login(bare) {
        return None;
    }
    bare.split('?').next()
}

/// True if an address without `@` begins with `name:`, but not with a port behind it.
fn may_be_half_a_login(address: &str) -> bool {
    let is_end = |c: char| matches!(c, '/' | '?' | '#') || c.is_whitespace();
    let authority = address.split(is_end).next().unwrap_or(address);
    if authority.contains('@') || authority.starts_with('[') {
        return false;
    }
    let port = authority.split_once(':').map(|(_, port)| port);
    port.is_some_and(|port| !port.bytes().all(|byte| byte.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_logins_are_hidden() {
        for (text, shown) in [
            ("rtsp://user:p@ss@camera:554/1", "rtsp://camera:554/1"),
            (
                "cannot open rtsp://127.0.0.1:1: refused",
                "cannot open rtsp://127.0.0.1:1: refused",
            ),
            (
                "at http://camera/video?user=admin&pwd=hush.",
                "at http://camera/video.",
            ),
            (
                "to http://[fe80::1]:80/x, 2 tries",
                "to http://[fe80::1]:80/x, 2 tries",
            ),
            (
                "cannot reach 10.0.0.2:1883: see ecod-node@edge",
                "cannot reach 10.0.0.2:1883: see ecod-node@edge",
            ),
            ("rtsp://admin:Geh/eim1@camera/1 failed", "rtsp://*** failed"),
            ("rtsp://admin:Geh?eim1@camera/1", "rtsp://***"),
            ("rtsp://admin:G@h/eim1@camera/1", "rtsp://***"),
            ("http://camera/a@b", "http://***"),
            ("rtsp://admin:ge heim1@camera/1 failed", "rtsp://***"),
            (
                "location=\"rtsp://admin:ge heim1@camera\" ! x",
                "location=\"rtsp://***\" ! x",
            ),
            ("'rtsp://admin:ge'heim1@camera'", "'rtsp://***"),
            ("rtsp://admin:ge\"heim1@camera/1", "rtsp://***"),
            ("rtsp://admin:p@ss wort@camera/1", "rtsp://***"),
            ("rtsp://admin:12 34@camera/1", "rtsp://***"),
            (
                "rtsp://u:p@one ! mix rtsp://u:p@two ! appsink",
                "rtsp://one ! mix rtsp://two ! appsink",
            ),
            (
                "'user:p@ss@broker:1883' must be host:port",
                "'***@broker:1883' must be host:port",
            ),
            (
                "error: invalid value 'user:ge heim1@broker' for '--broker <HOST:PORT>'",
                "error: invalid value '***@broker' for '--broker <HOST:PORT>'",
            ),
            (
                "invalid value 'user:geheim1@broker' for '--broker': \"***@broker\" must be host:port",
                "invalid value '***@broker' for '--broker': \"***@broker\" must be host:port",
            ),
            (
                "unexpected argument '--brokr=user:geh/eim1@broker' found",
                "unexpected argument '--brokr=***@broker' found",
            ),
            (
                "seeds: user:p@one user:p@two rtsp://u:p@three",
                "seeds: ***@two rtsp://three",
            ),
            (
                "error: ecod-node@edge is at 10.0.0.2:1883",
                "error: ecod-node@edge is at 10.0.0.2:1883",
            ),
            (
                "first\nmqtt://u:geheim1@broker:1883\nlast",
                "first\nmqtt://broker:1883\nlast",
            ),
        ] {
            assert_eq!(without_logins(text), shown);
        }
    }
}
