//! Requests of strangers to `ecod-node invite`, and texts that a person pastes into `ecod-node join`.
//!
//! The first byte of an input chooses what the rest is.

#![no_main]

use ecod_actors::transport::invitation::{Token, read_request, token_is_read_as_written};
use libfuzzer_sys::fuzz_target;

/// A request, up to the text of the certificate signing request and after it.
const REQUEST: [&str; 2] = [r#"{"node":"gauss","secret":"00","request":""#, "\"}\n"];

fuzz_target!(|input: &[u8]| {
    let Some((kind, bytes)) = input.split_first() else {
        return;
    };
    match kind % 4 {
        0 => drop(read_request(bytes)),
        1 => {
            let pem = String::from_utf8_lossy(bytes).replace('\n', "\\n");
            drop(read_request(
                [REQUEST[0], &pem, REQUEST[1]].concat().as_bytes(),
            ));
        }
        2 => drop(std::str::from_utf8(bytes).map(str::parse::<Token>)),
        _ => assert!(token_is_read_as_written(bytes)),
    }
});
