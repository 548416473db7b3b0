//! Image codecs in one place: JPEG, PNG, TIFF and raw pixel layouts; crop and resize.
