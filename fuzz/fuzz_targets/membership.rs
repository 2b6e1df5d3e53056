//! A node of the membership hears datagrams of strangers, and of a node that has the key and says anything with it.

#![no_main]

use ecod_actors::transport::gossip::fuzzing::Listener;
use libfuzzer_sys::arbitrary::{self, Arbitrary};
use libfuzzer_sys::fuzz_target;

#[derive(Debug, Arbitrary)]
enum Step {
    /// A datagram as it is.
    Datagram(Vec<u8>),
    /// A body under the peer's seal.
    Sealed { kind: u8, body: Vec<u8> },
    /// Nothing for a while.
    Wait { ms: u16 },
}

fuzz_target!(|input: (u8, Vec<Step>)| {
    let (cell, steps) = input;
    let proves = cell & 1 == 1;
    let mut listener = if cell & 2 == 2 { Listener::alone(proves) } else { Listener::meet(proves) };
    for step in steps {
        match step {
            Step::Datagram(frame) => listener.hear(&frame),
            Step::Sealed { kind, body } => listener.hear_sealed(kind, &body),
            Step::Wait { ms } => listener.wait(ms.into()),
        }
    }
    listener.assert_nobody_else();
});
