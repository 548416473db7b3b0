//! The world model in candle: encoder, predictor, heads, objectives, optimiser, checkpoints.
