//! Figures as SVG, and pages that hold them: one file, no script, no network, light and dark.

mod charts;
mod page;
mod reports;
mod svg;

pub use charts::{Bar, Line, Picture, bars, lines, pictures};
pub use page::{Page, escape};
pub use reports::{compare_page, diagnose_figures, diagnose_page, plan_figures, plan_page};
