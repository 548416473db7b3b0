//! Fused operations with exact backward: pure slice functions under thin candle adapters.

