//! What happens in one episode: the simulator's truth, without images.

use crate::environment::Environment;
use crate::rng::{Rng, Stream};
use crate::two_room::{ExpertConfig, TwoRoom, TwoRoomExpert};

/// What happened in one episode of TwoRoom.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    /// Number of the episode in its collection, from 0.
    pub index: u64,
    /// Seed of its start, its goal and its expert.
    pub seed: u64,
    /// Where the target is, in pixels.
    pub goal: [f32; 2],
    /// Position of the agent at each row, in pixels. One more than `actions`.
    pub states: Vec<[f32; 2]>,
    /// Action of each row but the last, as the environment met it.
    pub actions: Vec<[f32; 2]>,
    /// Whether the target was reached.
    pub success: bool,
}

impl Episode {
    /// Lets the expert act until the target is reached or `max_steps` are over.
    ///
    /// The episode depends on the seed of the collection and its own index alone.
    pub fn run(
        room: &mut TwoRoom,
        expert: ExpertConfig,
        max_steps: u32,
        collection_seed: u64,
        index: u64,
    ) -> Self {
        let seed = Rng::nth(collection_seed, Stream::Episodes, index);
        room.reset(seed);
        let mut expert = TwoRoomExpert::new(expert, seed);
        let mut states = vec![room.agent()];
        let mut actions = Vec::new();
        let mut success = false;
        while !success && actions.len() < max_steps as usize {
            let action = expert.act(room.config(), room.agent(), room.target());
            success = room.advance(action).terminated;
            actions.push(action);
            states.push(room.agent());
        }
        Episode { index, seed, goal: room.target(), states, actions, success }
    }
}
