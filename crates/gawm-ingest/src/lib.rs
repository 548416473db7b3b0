//! Raw robot and simulator logs to datasets.
#![forbid(unsafe_code)]

pub mod align;
pub mod cli;
pub mod contract;
pub mod decode;
pub mod episodes;
pub mod explain;
pub mod inspect;
pub mod lerobot;
pub mod log;
pub mod records;
mod rows;
pub mod run;
pub mod suggest;
pub mod tabular;

/// What to do about a build without video.
pub(crate) const VIDEO_HINT: &str = "build with `cargo build --release -p gawm-ingest --features video` (needs libavcodec-dev, libavformat-dev, libavutil-dev), convert the videos to images (lerobot-edit-dataset has convert_video_to_image), or remove its stream";
