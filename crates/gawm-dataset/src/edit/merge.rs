//! `merge`: all episodes of several datasets, in the order of the arguments.

use super::{Input, Plan};

/// Plans to put all episodes of the inputs one after the other.
pub fn merge(inputs: &[Input]) -> Plan {
    let pieces = inputs.iter().enumerate().flat_map(|(position, input)| input.pieces(position)).collect();
    Plan { verb: "merge".to_owned(), pieces, ..Plan::default() }
}
