//! Runs work on several threads and hands its results over in order, with bounded memory.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

struct Shared<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

struct State<T> {
    next_job: usize,
    next_out: usize,
    in_flight_bytes: u64,
    done: BTreeMap<usize, T>,
    is_stopped: bool,
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, guard: MutexGuard<'a, State<T>>) -> MutexGuard<'a, State<T>> {
        self.changed.wait(guard).unwrap_or_else(PoisonError::into_inner)
    }
}

/// Stops the workers when the consumer leaves, also by a panic.
struct StopOnDrop<'a, T>(&'a Shared<T>);

impl<T> Drop for StopOnDrop<'_, T> {
    fn drop(&mut self) {
        self.0.lock().is_stopped = true;
        self.0.changed.notify_all();
    }
}

/// Calls `work` for 0..costs.len() on `n_threads` threads and `consume` with each result, in order, on this one.
///
/// `costs` are the bytes that each result holds; no more than `budget_bytes` are worked on or waiting at a time, except
/// for the one that is needed next. With one thread, all is done on this one. `consume` may break off.
pub(crate) fn in_order<T: Send, E>(
    costs: &[u64],
    n_threads: usize,
    budget_bytes: u64,
    work: impl Fn(usize) -> T + Sync,
    mut consume: impl FnMut(usize, T) -> ControlFlow<E>,
) -> ControlFlow<E> {
    if n_threads <= 1 || costs.len() <= 1 {
        for index in 0..costs.len() {
            consume(index, work(index))?;
        }
        return ControlFlow::Continue(());
    }
    let shared = Shared {
        state: Mutex::new(State {
            next_job: 0,
            next_out: 0,
            in_flight_bytes: 0,
            done: BTreeMap::new(),
            is_stopped: false,
        }),
        changed: Condvar::new(),
    };
    std::thread::scope(|scope| {
        let _stop = StopOnDrop(&shared);
        for _ in 0..n_threads.min(costs.len()) {
            scope.spawn(|| worker(&shared, costs, budget_bytes, &work));
        }
        for index in 0..costs.len() {
            let mut state = shared.lock();
            let result = loop {
                if let Some(result) = state.done.remove(&index) {
                    break result;
                }
                if state.is_stopped {
                    // A worker has panicked; the scope passes that on.
                    return ControlFlow::Continue(());
                }
                state = shared.wait(state);
            };
            drop(state);
            let flow = consume(index, result);
            let mut state = shared.lock();
            state.in_flight_bytes = state.in_flight_bytes.saturating_sub(costs[index]);
            state.next_out = index + 1;
            drop(state);
            shared.changed.notify_all();
            flow?;
        }
        ControlFlow::Continue(())
    })
}

fn worker<T>(shared: &Shared<T>, costs: &[u64], budget_bytes: u64, work: &(impl Fn(usize) -> T + Sync)) {
    loop {
        let mut state = shared.lock();
        let index = loop {
            if state.is_stopped || state.next_job >= costs.len() {
                return;
            }
            let index = state.next_job;
            let fits = state.in_flight_bytes.saturating_add(costs[index]) <= budget_bytes;
            if fits || index == state.next_out {
                break index;
            }
            state = shared.wait(state);
        };
        state.next_job += 1;
        state.in_flight_bytes = state.in_flight_bytes.saturating_add(costs[index]);
        drop(state);
        let guard = PanicGuard(shared);
        let result = work(index);
        std::mem::forget(guard);
        shared.lock().done.insert(index, result);
        shared.changed.notify_all();
    }
}

/// Wakes the consumer when a worker panics, so that it does not wait for ever.
struct PanicGuard<'a, T>(&'a Shared<T>);

impl<T> Drop for PanicGuard<'_, T> {
    fn drop(&mut self) {
        self.0.lock().is_stopped = true;
        self.0.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    fn check_order(n_threads: usize, budget: u64) {
        let costs: Vec<u64> = (0..200).map(|k| k % 17 + 1).collect();
        let held = AtomicU64::new(0);
        let mut got = Vec::new();
        let flow: ControlFlow<()> = in_order(
            &costs,
            n_threads,
            budget,
            |index| {
                held.fetch_add(costs[index], Ordering::SeqCst);
                index * 3
            },
            |index, value| {
                // One result above the budget is allowed: the one that is needed next.
                assert!(held.fetch_sub(costs[index], Ordering::SeqCst) <= budget + 17);
                got.push((index, value));
                ControlFlow::Continue(())
            },
        );
        assert!(flow.is_continue());
        assert_eq!(got, (0..200).map(|k| (k, k * 3)).collect::<Vec<_>>());
    }

    #[test]
    fn results_come_in_order_and_within_the_budget() {
        check_order(1, 1);
        check_order(2, 40);
        check_order(4, 1);
        check_order(3, 10_000);
    }

    #[test]
    fn breaking_off_stops_the_workers() {
        let costs = vec![1; 1000];
        let mut seen = 0;
        let flow = in_order(&costs, 3, 10, |index| index, |_, index| {
            seen += 1;
            if index == 5 { ControlFlow::Break("enough") } else { ControlFlow::Continue(()) }
        });
        assert_eq!(flow, ControlFlow::Break("enough"));
        assert_eq!(seen, 6);
    }
}
