//! The learning rate of each step.

/// Linear warm-up from 0, then half a cosine down to 0, by optimiser step.
///
/// ```text
/// rate(i) = base * i / W                                    for i < W
///         = base * (1 + cos(pi (i - W) / (N - W))) / 2      else
/// ```
///
/// The first step has rate 0, as published.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WarmupCosine {
    /// The highest rate.
    pub base: f64,
    /// Steps `W` of warm-up.
    pub warmup_steps: u64,
    /// Steps `N` in all.
    pub total_steps: u64,
}

impl WarmupCosine {
    /// Makes the published schedule: warm-up over a hundredth of the steps, at least one.
    pub fn published(base: f64, total_steps: u64) -> WarmupCosine {
        WarmupCosine { base, warmup_steps: (total_steps / 100).max(1), total_steps }
    }

    /// Returns the rate of step `step`, counted from 0; 0 from the end on.
    pub fn rate(&self, step: u64) -> f64 {
        if step < self.warmup_steps {
            return self.base * step as f64 / self.warmup_steps as f64;
        }
        if step >= self.total_steps {
            return 0.0;
        }
        let progress = (step - self.warmup_steps) as f64 / (self.total_steps - self.warmup_steps) as f64;
        self.base * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_equal_the_published_ones() {
        let schedule = WarmupCosine::published(5e-5, 1000);
        for (step, expected) in [
            (0, 0.0),
            (1, 5e-6),
            (9, 4.5e-5),
            (10, 5e-5),
            (11, 4.999_987_412_513_878e-5),
            (500, 2.539_664_909_587_020_2e-5),
            (998, 5.034_981_773_371_916e-10),
            (999, 1.258_748_612_231_741_6e-10),
        ] {
            let rate = schedule.rate(step);
            assert!((rate - expected).abs() <= 1e-15 * 5e-5 + 1e-13 * expected, "step {step}: {rate:e}");
        }
        assert_eq!(schedule.rate(1000), 0.0);
    }

    #[test]
    fn short_runs_have_one_step_of_warmup() {
        let schedule = WarmupCosine::published(1.0, 2);
        assert_eq!([0, 1, 2].map(|step| schedule.rate(step)), [0.0, 1.0, 0.0]);
    }
}
