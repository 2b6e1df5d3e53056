//! The laboratory of ECOD: tools that measure and show a cell. They don't run on vehicles.
//!
//! ```text
//! traffic   generated towns: reports and truth
//! town      many cells in generated traffic, virtual time              (uses traffic, eval)
//! eval      accuracy of maps, verdicts and objects by what is true
//! testbed   recorded scenes: geometry, renderer, virtual-time trials   (uses eval)
//! street    a street that moves: truth, network cameras, animation    (uses eval, testbed)
//! drawing   page and font of drawings
//! document  tables in the manual
//! report    the page about a log, judged                              (uses eval)
//! bench     load on a live cell                                       (starts ecod-node)
//! demo      a whole cell on this machine                              (uses testbed and street, starts ecod-node)
//! cli       the program ecod-lab
//! ```

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod bench;
pub mod cli;
pub mod demo;
pub mod document;
mod drawing;
pub mod eval;
pub mod node_process;
pub mod report;
pub mod street;
pub mod testbed;
pub mod town;
pub mod traffic;
