//! A node of the membership receives datagrams of strangers, arbitrary messages sealed by a holder of the key, and
//! arbitrary handshakes signed by a node.

#![no_main]

use ecod_actors::transport::gossip::fuzzing::{Edits, Listener};
use libfuzzer_sys::arbitrary::{self, Arbitrary};
use libfuzzer_sys::fuzz_target;

#[derive(Debug, Arbitrary)]
enum Step {
    /// A datagram as it is.
    Datagram(Vec<u8>),
    /// A body under the peer's seal.
    Sealed {
        kind: u8,
        body: Vec<u8>,
    },
    /// A greeting of the peer.
    Greeting {
        wants_session: bool,
    },
    /// A step of the peer's handshake, as it should be but for these changes.
    Challenge {
        edits: Edits,
    },
    Proof {
        message: Edits,
        attestation: Edits,
    },
    Accept {
        message: Edits,
        attestation: Edits,
    },
    /// Nothing for a while.
    Wait {
        ms: u16,
    },
}

fuzz_target!(|input: (u8, Vec<Step>)| {
    let (cell, steps) = input;
    let proves = cell & 1 == 1;
    // A meeting costs as much as many other steps.
    let mut listener = if cell & 0b1110 == 0 {
        Listener::member_up(proves)
    } else {
        Listener::alone(proves)
    };
    for step in steps {
        match step {
            Step::Datagram(frame) => listener.receive(&frame),
            Step::Sealed { kind, body } => listener.receive_sealed(kind, &body),
            Step::Greeting { wants_session } => listener.receive_greeting(wants_session),
            Step::Challenge { edits } => listener.receive_challenge(&edits),
            Step::Proof {
                message,
                attestation,
            } => listener.receive_proof(&message, &attestation),
            Step::Accept {
                message,
                attestation,
            } => listener.receive_accept(&message, &attestation),
            Step::Wait { ms } => listener.wait(ms.into()),
        }
    }
    listener.assert_nobody_else();
});
