//! Contact sheets: what a solver did, one row of pictures per problem.

use gawm_image::{Image, ImageError, Pixels, encode_png};
use gawm_sim::Frame;

use crate::encode::fit_frame;
use crate::evaluate::Outcome;
use crate::latent::goal_frame;
use crate::problem::Problem;
use crate::world::World;

/// Side of a picture.
const THUMBNAIL: usize = 96;
/// Pixels between pictures.
const GAP: usize = 4;
/// Pictures of each problem between start and goal.
const MOMENTS: usize = 6;
/// Colours of the gaps: solved, not solved.
const SOLVED: [u8; 3] = [46, 160, 67];
const UNSOLVED: [u8; 3] = [207, 34, 46];

/// Draws up to `rows` problems as PNG: start, moments at equal steps, last, goal; green frames for solved problems.
///
/// The recorded actions are taken again in a fresh environment, so nothing has to be kept while a solver runs.
///
/// # Errors
/// - [`ImageError`] for pictures that cannot be made.
pub fn contact_sheet(
    world: &dyn World,
    problems: &[Problem],
    outcomes: &[Outcome],
    rows: usize,
) -> Result<Vec<u8>, ImageError> {
    let n = rows.min(problems.len()).max(1);
    let (columns, cell) = (MOMENTS + 2, THUMBNAIL + GAP);
    let (width, height) = (columns * cell + GAP, n * cell + GAP);
    let mut sheet = vec![255u8; width * height * 3];
    for (row, (problem, outcome)) in problems.iter().zip(outcomes).take(n).enumerate() {
        let color = if outcome.success_any { SOLVED } else { UNSOLVED };
        for y in row * cell..(row + 1) * cell + GAP {
            for pixel in sheet[y * width * 3..(y + 1) * width * 3].chunks_exact_mut(3) {
                pixel.copy_from_slice(&color);
            }
        }
        for (column, frame) in frames(world, problem, outcome).iter().enumerate() {
            let picture = fit_frame(frame, (THUMBNAIL, THUMBNAIL))?;
            for (y, line) in picture.chunks_exact(THUMBNAIL * 3).enumerate() {
                let at = ((row * cell + GAP + y) * width + column * cell + GAP) * 3;
                sheet[at..at + line.len()].copy_from_slice(line);
            }
        }
    }
    encode_png(&Image::try_new(width as u32, height as u32, Pixels::Rgb8(sheet))?)
}

/// Renders start, moments and goal of one problem; fewer where the environment refuses.
fn frames(world: &dyn World, problem: &Problem, outcome: &Outcome) -> Vec<Frame> {
    let mut environment = world.environment();
    let mut frames = Vec::with_capacity(MOMENTS + 2);
    if environment.set_state(&problem.state).is_err() {
        return frames;
    }
    let mut look = |environment: &dyn gawm_sim::Environment| {
        let mut frame = Frame::default();
        environment.render(&mut frame);
        frames.push(frame);
    };
    look(environment.as_ref());
    let n = outcome.actions.len();
    for (step, action) in outcome.actions.iter().enumerate() {
        if environment.step(action).is_err() {
            break;
        }
        let is_moment = (1..=MOMENTS).any(|moment| step + 1 == (moment * n).div_ceil(MOMENTS));
        if is_moment {
            look(environment.as_ref());
        }
    }
    frames.resize_with(MOMENTS + 1, || Frame { width: 1, height: 1, rgb: vec![128; 3] });
    frames.extend(goal_frame(world, problem).ok());
    frames
}
