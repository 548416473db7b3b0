//! Contracts of recordings that come from other datasets.

use super::DatasetWriter;
use crate::provenance::Contract;

impl DatasetWriter {
    /// Says which contract the recordings that begin from now on were made with; without this it is that of the
    /// specification.
    pub(crate) fn use_contract(&mut self, text: &str) {
        let contract = Contract::new(text);
        self.contract = contract.hash;
        if !self.meta.contracts.contains(&contract) {
            self.meta.contracts.push(contract);
        }
    }
}
