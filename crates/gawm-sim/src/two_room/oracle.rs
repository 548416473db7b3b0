//! A solver that knows the wall: the shortest way through a door, and the floors that it is compared with.

use super::config::WALL_CENTER_PX;
use super::dynamics::{Geometry, distance_px};
use super::expert::unit_direction;

/// How far inside of a door's ends the way is laid.
const PASSAGE_INSET_PX: f32 = 0.5;
/// How far before the wall the way turns.
const WALL_CLEARANCE_PX: f32 = 0.5;
/// A turning point nearer than this counts as reached. Less than the inset, so that who reached one is in the door.
const REACHED_PX: f32 = 0.4;
/// Rounds of the alternating minimisation that lays a way through a door; each shrinks the error by a large factor.
const TURNING_POINT_ROUNDS: usize = 24;

/// Returns the action that follows the shortest way round the wall at full speed and stops at the goal.
///
/// The way ends at the place nearest to the goal that an agent can reach, since goals may lie in the wall or too near
/// to the border. The length of the vector is at most 1, as the published expert's without noise.
pub fn oracle_action(geometry: &Geometry, agent: [f32; 2], goal: [f32; 2]) -> [f32; 2] {
    let way = shortest_way(geometry, agent, goal);
    let last = way.len() - 1;
    let next = way
        .iter()
        .enumerate()
        .find(|&(i, &point)| i == last || distance_px(agent, point) > REACHED_PX)
        .map_or(goal, |(_, &point)| point);
    towards(geometry, agent, next)
}

/// Returns the action of a solver that ignores the wall: straight to the goal. A floor for every planner.
pub fn straight_line_action(geometry: &Geometry, agent: [f32; 2], goal: [f32; 2]) -> [f32; 2] {
    towards(geometry, agent, goal)
}

/// A vector of length 1 towards a point, shorter where a full step would go past it.
fn towards(geometry: &Geometry, agent: [f32; 2], point: [f32; 2]) -> [f32; 2] {
    let scale = (distance_px(agent, point) / geometry.speed_px).min(1.0);
    unit_direction(agent, point).map(|component| component * scale)
}

/// Returns the turning points of the shortest way, the last being its end. Never empty.
fn shortest_way(geometry: &Geometry, agent: [f32; 2], goal: [f32; 2]) -> Vec<[f32; 2]> {
    let agent = to_wall_frame(geometry, agent);
    let ways = reachable_ends(geometry, to_wall_frame(geometry, goal)).into_iter().flat_map(|end| {
        let doors = geometry
            .passages_px
            .iter()
            .filter_map(move |&passage| way_through(geometry, passage, agent, end));
        let direct = (side(geometry, agent) == side(geometry, end) && side(geometry, end) != Side::InWall)
            .then(|| vec![end]);
        doors.chain(direct)
    });
    let shortest = ways.min_by(|a, b| length(agent, a).total_cmp(&length(agent, b)));
    shortest.unwrap_or_else(|| vec![agent]).into_iter().map(|point| to_wall_frame(geometry, point)).collect()
}

/// Exchanges the coordinates of a horizontal wall, so that index 0 is across the wall. Its own inverse.
fn to_wall_frame(geometry: &Geometry, point: [f32; 2]) -> [f32; 2] {
    [point[geometry.axis.across()], point[geometry.axis.along()]]
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Low,
    High,
    InWall,
}

fn side(geometry: &Geometry, point: [f32; 2]) -> Side {
    if f64::from(point[0]) <= geometry.wall_low_px {
        Side::Low
    } else if f64::from(point[0]) >= geometry.wall_high_px {
        Side::High
    } else {
        Side::InWall
    }
}

/// The places nearest to a goal where an agent can stand: one, or for a goal in the wall one on each side.
fn reachable_ends(geometry: &Geometry, goal: [f32; 2]) -> Vec<[f32; 2]> {
    let goal = goal.map(|c| c.clamp(geometry.room_low_px, geometry.room_high_px));
    if side(geometry, goal) != Side::InWall || geometry.in_passage(goal[1]) {
        return vec![goal];
    }
    let [low, high] = wall_faces(geometry);
    let mut ends = vec![[low, goal[1]], [high, goal[1]]];
    // Where the far face is too far from the goal to count as solved, only the near one is an end.
    ends.sort_by(|a, b| (a[0] - goal[0]).abs().total_cmp(&(b[0] - goal[0]).abs()));
    let solves = |end: &[f32; 2]| f64::from(distance_px(*end, goal)) < super::config::SUCCESS_RADIUS_PX - 1.0;
    if !solves(&ends[1]) {
        ends.truncate(1);
    }
    ends
}

/// Where the way turns before the wall, on its low and its high side.
fn wall_faces(geometry: &Geometry) -> [f32; 2] {
    [geometry.wall_low_px as f32 - WALL_CLEARANCE_PX, geometry.wall_high_px as f32 + WALL_CLEARANCE_PX]
}

/// Returns the turning points of the shortest way through one door, or `None` when it does not lead there.
fn way_through(
    geometry: &Geometry,
    passage: [f32; 2],
    agent: [f32; 2],
    end: [f32; 2],
) -> Option<Vec<[f32; 2]>> {
    let (agent_side, end_side) = (side(geometry, agent), side(geometry, end));
    if agent_side == end_side && agent_side != Side::InWall {
        return None;
    }
    let first = (passage[0] + PASSAGE_INSET_PX).max(geometry.room_low_px);
    let last = (passage[1] - PASSAGE_INSET_PX).min(geometry.room_high_px);
    let leads_here =
        first <= last && (end_side != Side::InWall || (passage[0]..=passage[1]).contains(&end[1]));
    if !leads_here {
        return None;
    }
    if agent_side == Side::InWall && !(passage[0]..=passage[1]).contains(&agent[1]) {
        return leave_wall(geometry, passage, agent, end);
    }
    // The way turns before the wall, or where it touches the wall already.
    let [low, high] = wall_faces(geometry);
    let gate = |side, across_px: f32| match side {
        Side::Low => Some(low.max(across_px)),
        Side::High => Some(high.min(across_px)),
        Side::InWall => None,
    };
    let gates = [gate(agent_side, agent[0]), gate(end_side, end[0])];
    let mut way: Vec<[f32; 2]> =
        gates.into_iter().flatten().map(|gate| [gate, (first + last) / 2.0]).collect();
    way.push(end);
    lay_through_gates(&mut way, agent, first, last);
    Some(way)
}

/// An agent in the wall beside this door is put back on its side by any step; the way begins there.
fn leave_wall(
    geometry: &Geometry,
    passage: [f32; 2],
    agent: [f32; 2],
    end: [f32; 2],
) -> Option<Vec<[f32; 2]>> {
    let [low, high] = wall_faces(geometry);
    let face = [if agent[0] < WALL_CENTER_PX { low } else { high }, agent[1]];
    let mut way = vec![face];
    if side(geometry, face) == side(geometry, end) {
        way.push(end);
    } else {
        way.extend(way_through(geometry, passage, face, end)?);
    }
    Some(way)
}

/// Moves the turning points (all but the last) along their gates until the way is shortest.
fn lay_through_gates(way: &mut [[f32; 2]], agent: [f32; 2], first: f32, last: f32) {
    for _ in 0..TURNING_POINT_ROUNDS {
        for i in 0..way.len() - 1 {
            let before = if i == 0 { agent } else { way[i - 1] };
            let after = way[i + 1];
            let fraction = (way[i][0] - before[0]) / (after[0] - before[0]);
            way[i][1] = (before[1] + fraction * (after[1] - before[1])).clamp(first, last);
        }
    }
}

/// Length of a way that begins at the agent.
fn length(agent: [f32; 2], way: &[[f32; 2]]) -> f32 {
    std::iter::once(&agent).chain(way).zip(way).map(|(a, b)| distance_px(*a, *b)).sum()
}
