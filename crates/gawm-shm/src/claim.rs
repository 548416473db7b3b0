//! The right of one trainer to a service name.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::error::ShmError;
use crate::lock::{self, Lock};
use crate::place::{Place, ServicePlace};
use crate::subscriber::Subscriber;

/// The right of one trainer to a service name; given up when dropped.
///
/// Taking it removes what an earlier trainer of the name and its loaders left behind.
#[derive(Debug)]
pub struct Claim {
    service: ServicePlace,
    // Last, so that the name is free only after everything else is gone.
    lock: Option<Lock>,
}

impl Claim {
    /// Takes the name, waiting until `deadline` for an earlier trainer and its loaders to end.
    ///
    /// # Errors
    /// - [`ShmError::BadName`]
    /// - [`ShmError::NameInUse`] if another trainer is alive
    /// - [`ShmError::LoaderInUse`] if a loader of an earlier trainer is alive and does not end
    /// - [`ShmError::Io`] if files cannot be made or removed
    pub fn take(place: &Place, name: &str, deadline: Instant) -> Result<Claim, ShmError> {
        let service = place.service(name)?;
        service.create()?;
        let path = service.trainer_lock();
        let Some(lock) = Lock::take_until(&path, deadline)? else {
            return Err(ShmError::NameInUse { name: name.to_owned(), process: lock::holder(&path) });
        };
        let claim = Claim { service, lock: Some(lock) };
        for loader in claim.service.loaders()? {
            claim.sweep(loader, deadline)?;
        }
        Ok(claim)
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.service.name
    }

    /// Opens the trainer's side for loader `loader` of `loaders`: the loader can be started now.
    ///
    /// An earlier subscriber for the same loader must be dropped before. A loader that is still attached to it leaves
    /// by itself (a hung one must be killed); what it made is removed.
    ///
    /// # Errors
    /// - [`ShmError::LoaderInUse`] if an earlier loader of this number does not end before the deadline
    /// - [`ShmError::Transport`], [`ShmError::Io`]
    ///
    /// # Panics
    /// If `loader` is not below `loaders`.
    pub fn subscribe(&self, loader: u32, loaders: u32, deadline: Instant) -> Result<Subscriber, ShmError> {
        assert!(loader < loaders, "loader {loader} of {loaders}");
        let domain = self.service.domain(loader);
        // Held until the service is there, so that no loader sees half of it.
        let _lock = self.sweep(loader, deadline)?;
        let token = new_token()?;
        let subscriber = Subscriber::open(domain.clone(), token.clone(), loaders)?;
        domain.write_ready(&token)?;
        Ok(subscriber)
    }

    fn sweep(&self, loader: u32, deadline: Instant) -> Result<Lock, ShmError> {
        let domain = self.service.domain(loader);
        domain.remove_ready()?;
        let path = domain.lock_path();
        let Some(lock) = Lock::take_until(&path, deadline)? else {
            let process = lock::holder(&path);
            return Err(ShmError::LoaderInUse { name: self.name().to_owned(), loader, process });
        };
        domain.sweep()?;
        Ok(lock)
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Loaders that are still ending remove their files themselves, or the next start or `clean` does.
        let deadline = Instant::now() + Duration::from_millis(20);
        let swept = self.service.loaders().and_then(|loaders| {
            loaders.into_iter().try_for_each(|loader| self.sweep(loader, deadline)?.remove())
        });
        if swept.is_ok()
            && let Some(lock) = self.lock.take()
        {
            // Nothing depends on it: an empty folder that stays is used again.
            self.service.forget(lock).ok();
        }
    }
}

/// Returns a name that no other trainer and no earlier attempt has.
fn new_token() -> Result<String, ShmError> {
    let path = Path::new("/proc/sys/kernel/random/uuid");
    let token = fs::read_to_string(path).map_err(ShmError::io("read", path))?;
    Ok(token.trim().to_owned())
}
