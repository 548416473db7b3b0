//! An allocator that keeps its pages.

/// Makes the C library's allocator keep freed memory instead of giving it back to the system.
///
/// Tensors of a step are freed and allocated again in every step; by default each of more than 32 MB, and many smaller
/// ones, comes as fresh zeroed pages, whose first touch costs a fault per 4 KiB. Called once at the start of a program
/// that trains or plans. Does nothing where the allocator is not glibc's. Returns whether the setting was taken.
pub fn keep_pages() -> bool {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        // SAFETY: mallopt takes two integers and is thread-safe; M_MMAP_MAX 0 keeps large blocks on the heap.
        let on_heap = unsafe { libc::mallopt(libc::M_MMAP_MAX, 0) };
        // SAFETY: as above; the largest threshold means that the heap never shrinks.
        let kept = unsafe { libc::mallopt(libc::M_TRIM_THRESHOLD, libc::c_int::MAX) };
        on_heap == 1 && kept == 1
    }
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    false
}
