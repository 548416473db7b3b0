//! Round trips, layouts by hand, and damaged files.

use proptest::prelude::*;

use crate::*;

/// A smooth picture with some structure, so that JPEG has coefficients to lose.
fn picture(width: u32, height: u32) -> Image {
    let values = (0..height).flat_map(|y| {
        (0..width)
            .flat_map(move |x| [(x * 3 + y) % 256, (x + y * 2) % 256, (x * y / 7) % 256].map(|v| v as u8))
    });
    Image::try_new(width, height, Pixels::Rgb8(values.collect())).unwrap()
}

fn gray(width: u32, height: u32) -> Image {
    to_gray8(picture(width, height)).unwrap()
}

fn largest_difference(a: &Image, b: &Image) -> u8 {
    let (Pixels::Rgb8(a) | Pixels::Gray8(a), Pixels::Rgb8(b) | Pixels::Gray8(b)) = (a.pixels(), b.pixels())
    else {
        panic!("8-bit images")
    };
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

fn raw<'a>(layout: &'a str, width: u32, height: u32, step: u32, data: &'a [u8]) -> RawImage<'a> {
    RawImage { layout, width, height, step, is_big_endian: false, data }
}

fn decode_rgb(raw: &RawImage<'_>) -> Vec<u8> {
    match decode_raw(raw, &Limits::default()).unwrap().into_pixels() {
        Pixels::Rgb8(values) => values,
        other => panic!("{}", other.name()),
    }
}

#[test]
fn lossless_files_give_the_same_image() {
    let depth16 = Image::try_new(3, 2, Pixels::Gray16(vec![0, 1, 256, 65_535, 7, 1000])).unwrap();
    for image in [picture(31, 17), gray(31, 17), depth16] {
        let png = encode_png(&image).unwrap();
        assert_eq!(decode(&png, &Limits::default()).unwrap(), image);
        assert_eq!(encode_png(&image).unwrap(), png);
        let header = verify(&png).unwrap();
        assert_eq!((header.width, header.height), (image.width(), image.height()));
        assert_eq!(decode(&encode_tiff(&image).unwrap(), &Limits::default()).unwrap(), image);
    }
}

#[test]
fn float_depth_keeps_its_bits() {
    let values = vec![0.5, f32::NAN, f32::INFINITY, -0.0, 1e-30, 3.25];
    let image = Image::try_new(3, 2, Pixels::GrayF32(values.clone())).unwrap();
    let file = encode_tiff(&image).unwrap();
    assert_eq!(encode_tiff(&image).unwrap(), file);
    let Pixels::GrayF32(got) = decode(&file, &Limits::default()).unwrap().into_pixels() else {
        panic!("floats")
    };
    let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&got), bits(&values));
    assert!(matches!(encode_png(&image), Err(ImageError::Unsuitable { .. })));
    assert!(matches!(encode_jpeg(&image, 90), Err(ImageError::Unsuitable { .. })));
}

#[test]
fn jpeg_is_close_and_its_header_right() {
    for image in [picture(64, 48), gray(64, 48)] {
        let file = encode_jpeg(&image, 95).unwrap();
        let back = decode(&file, &Limits::default()).unwrap();
        assert_eq!((back.width(), back.height(), back.pixels().name()), (64, 48, image.pixels().name()));
        // Sharp edges in `picture` (values wrap at 256) ring, and colour is at half resolution.
        let most = if matches!(image.pixels(), Pixels::Gray8(_)) { 32 } else { 160 };
        assert!(largest_difference(&image, &back) < most, "{}", largest_difference(&image, &back));
        let header = verify(&file).unwrap();
        assert_eq!((header.width, header.height, header.format), (64, 48, FileFormat::Jpeg));
    }
}

#[test]
fn decoding_into_a_buffer_is_decoding() {
    for file in [
        encode_jpeg(&picture(40, 24), 90).unwrap(),
        encode_jpeg(&gray(40, 24), 90).unwrap(),
        encode_png(&picture(40, 24)).unwrap(),
        encode_png(&gray(40, 24)).unwrap(),
    ] {
        let mut out = vec![0; 40 * 24 * 3];
        decode_rgb_into(&file, 40, 24, &mut out).unwrap();
        let whole = to_rgb8(decode(&file, &Limits::default()).unwrap()).unwrap();
        assert_eq!(whole.into_pixels(), Pixels::Rgb8(out.clone()));
        let mismatch = decode_rgb_into(&file, 24, 40, &mut out).unwrap_err();
        assert!(matches!(mismatch, ImageError::Mismatch { width: 40, height: 24, .. }));
        assert!(matches!(decode_rgb_into(&file, 40, 24, &mut out[1..]), Err(ImageError::Values { .. })));
    }
}

#[test]
fn a_file_that_is_cut_off_is_refused() {
    for file in [encode_jpeg(&picture(64, 48), 90).unwrap(), encode_png(&picture(64, 48)).unwrap()] {
        for cut in [4, 20, file.len() / 4, file.len() / 2, file.len() * 9 / 10] {
            assert!(verify(&file[..cut]).is_err(), "verify at {cut} of {}", file.len());
            assert!(decode(&file[..cut], &Limits::default()).is_err(), "decode at {cut} of {}", file.len());
        }
    }
}

#[test]
fn formats_are_known_by_content() {
    assert_eq!(sniff(&encode_jpeg(&picture(8, 8), 90).unwrap()), Some(FileFormat::Jpeg));
    assert_eq!(sniff(&encode_png(&picture(8, 8)).unwrap()), Some(FileFormat::Png));
    let webp = b"RIFF\x10\0\0\0WEBPVP8 ";
    assert_eq!(
        decode(webp, &Limits::default()).unwrap_err(),
        ImageError::UnsupportedFormat { format: FileFormat::WebP }
    );
    assert!(matches!(decode(b"hello", &Limits::default()), Err(ImageError::UnknownFormat { .. })));
    assert!(matches!(decode(b"", &Limits::default()), Err(ImageError::UnknownFormat { .. })));
}

#[test]
fn sizes_are_capped_before_memory_is_asked_for() {
    let file = encode_png(&picture(64, 48)).unwrap();
    let limits = Limits { max_pixels: 1000 };
    assert!(matches!(
        decode(&file, &limits),
        Err(ImageError::Size { width: 64, height: 48, max_pixels: 1000 })
    ));
    let mut huge = file.clone();
    huge[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    assert!(matches!(decode(&huge, &Limits::default()), Err(ImageError::Size { .. })));
    let jpeg = encode_jpeg(&picture(64, 48), 90).unwrap();
    assert!(matches!(decode(&jpeg, &limits), Err(ImageError::Size { .. })));
    assert!(matches!(
        decode_raw(&raw("rgb8", u32::MAX, u32::MAX, 0, &[]), &Limits::default()),
        Err(ImageError::Size { .. })
    ));
    assert!(matches!(
        decode_raw(&raw("rgb8", 0, 5, 0, &[]), &Limits::default()),
        Err(ImageError::Size { .. })
    ));
}

#[test]
fn byte_orders_and_padding() {
    // Two pixels per row, rows padded.
    assert_eq!(decode_rgb(&raw("rgb8", 1, 2, 4, &[1, 2, 3, 99, 4, 5, 6])), [1, 2, 3, 4, 5, 6]);
    assert_eq!(decode_rgb(&raw("bgr8", 1, 2, 0, &[3, 2, 1, 6, 5, 4])), [1, 2, 3, 4, 5, 6]);
    assert_eq!(decode_rgb(&raw("8UC3", 1, 1, 3, &[3, 2, 1])), [1, 2, 3]);
    assert_eq!(decode_rgb(&raw("rgba8", 2, 1, 8, &[1, 2, 3, 9, 4, 5, 6, 9])), [1, 2, 3, 4, 5, 6]);
    assert_eq!(decode_rgb(&raw("BGRA8", 1, 1, 4, &[3, 2, 1, 9])), [1, 2, 3]);
    assert_eq!(decode_rgb(&raw("rgb16", 1, 1, 6, &[0, 1, 0, 2, 0, 3])), [1, 2, 3]);
    let wide = |is_big_endian| RawImage { is_big_endian, ..raw("16UC1", 2, 1, 6, &[1, 0, 0, 2, 9, 9]) };
    let pixels = |raw: &RawImage<'_>| decode_raw(raw, &Limits::default()).unwrap().into_pixels();
    assert_eq!(pixels(&wide(false)), Pixels::Gray16(vec![1, 512]));
    assert_eq!(pixels(&wide(true)), Pixels::Gray16(vec![256, 2]));
    let float = 1.5_f32.to_be_bytes();
    let raw_float = RawImage { is_big_endian: true, ..raw("32FC1", 1, 1, 4, &float) };
    assert_eq!(pixels(&raw_float), Pixels::GrayF32(vec![1.5]));
    assert_eq!(pixels(&raw("mono8", 2, 2, 3, &[1, 2, 9, 3, 4])), Pixels::Gray8(vec![1, 2, 3, 4]));
}

#[test]
fn yuv_is_limited_range_bt601() {
    // Black, white, and the red of BT.601.
    let (black, white, red) = ([16, 128, 128], [235, 128, 128], [81, 90, 240]);
    let yuyv: Vec<u8> = [black, white].iter().flat_map(|[y, u, v]| [*y, *u, *y, *v]).collect();
    assert_eq!(decode_rgb(&raw("yuyv", 4, 1, 8, &yuyv)), [0, 0, 0, 0, 0, 0, 255, 255, 255, 255, 255, 255]);
    let [y, u, v] = red;
    let close =
        |got: &[u8]| got.iter().zip([255, 0, 0].iter().cycle()).all(|(a, b): (&u8, &u8)| a.abs_diff(*b) <= 2);
    assert!(close(&decode_rgb(&raw("yuv422_yuy2", 2, 1, 4, &[y, u, y, v]))));
    assert!(close(&decode_rgb(&raw("uyvy", 2, 1, 4, &[u, y, v, y]))));
    assert!(close(&decode_rgb(&raw("nv12", 2, 2, 2, &[y, y, y, y, u, v]))));
    assert!(close(&decode_rgb(&raw("nv21", 2, 2, 2, &[y, y, y, y, v, u]))));
    // Odd sizes have half a pair more of colour.
    assert!(close(&decode_rgb(&raw(
        "nv12",
        3,
        3,
        4,
        &[y, y, y, 0, y, y, y, 0, y, y, y, 0, u, v, u, v, u, v, u, v]
    ))));
    assert!(close(&decode_rgb(&raw("yuyv", 3, 1, 8, &[y, u, y, v, y, u, y, v]))));
}

#[test]
fn raw_images_that_do_not_fit_are_refused() {
    let limits = Limits::default();
    let error = |raw: &RawImage<'_>| decode_raw(raw, &limits).unwrap_err();
    assert!(matches!(
        error(&raw("rgb8", 2, 2, 6, &[0; 11])),
        ImageError::Short { expected: 12, got: 11, .. }
    ));
    assert!(matches!(error(&raw("rgb8", 2, 2, 5, &[0; 12])), ImageError::Step { expected: 6, got: 5, .. }));
    assert!(matches!(error(&raw("nv12", 2, 2, 2, &[0; 5])), ImageError::Short { .. }));
    assert!(matches!(error(&raw("rgb8", 1, 2, u32::MAX, &[0; 12])), ImageError::Short { .. }));
    for layout in ["bayer_rggb8", "h264", ""] {
        assert_eq!(
            error(&raw(layout, 1, 1, 1, &[0])),
            ImageError::UnsupportedLayout { layout: layout.into() }
        );
    }
}

#[test]
fn crop_and_resize() {
    let image = gray(8, 6);
    let part = crop(&image, CropRect { x: 2, y: 1, width: 3, height: 2 }).unwrap();
    let (Pixels::Gray8(all), Pixels::Gray8(some)) = (image.pixels(), part.pixels()) else { panic!("grey") };
    assert_eq!(some[..], [&all[10..13], &all[18..21]].concat()[..]);
    assert!(matches!(
        crop(&image, CropRect { x: 6, y: 0, width: 3, height: 1 }),
        Err(ImageError::Crop { .. })
    ));
    assert!(crop(&image, CropRect { x: u32::MAX, y: 0, width: u32::MAX, height: 1 }).is_err());
    assert!(crop(&image, CropRect { x: 0, y: 0, width: 0, height: 1 }).is_err());
    let flat = Image::try_new(8, 8, Pixels::Rgb8(vec![77; 192])).unwrap();
    assert_eq!(resize(&flat, 3, 5).unwrap().into_pixels(), Pixels::Rgb8(vec![77; 45]));
    let depth = Image::try_new(4, 1, Pixels::GrayF32(vec![1.0, f32::NAN, 3.0, 4.0])).unwrap();
    assert_eq!(resize(&depth, 8, 1).unwrap().width(), 8);
    let Pixels::GrayF32(near) = resize(&depth, 2, 1).unwrap().into_pixels() else { panic!("floats") };
    assert!(near[0].is_nan() && near[1].to_bits() == 4.0_f32.to_bits());
    assert!(resize(&depth, 0, 1).is_err());
}

#[test]
fn palette_alpha_and_small_depths_of_png() {
    let encode = |color, depth, palette: Option<&[u8]>, data: &[u8], width| {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, width, 1);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if let Some(palette) = palette {
            encoder.set_palette(palette.to_vec());
        }
        encoder.write_header().unwrap().write_image_data(data).unwrap();
        decode(&out, &Limits::default()).unwrap().into_pixels()
    };
    use png::{BitDepth, ColorType};
    let palette = [9, 8, 7, 6, 5, 4];
    assert_eq!(
        encode(ColorType::Indexed, BitDepth::Eight, Some(&palette), &[1, 0], 2),
        Pixels::Rgb8(vec![6, 5, 4, 9, 8, 7])
    );
    assert_eq!(
        encode(ColorType::Grayscale, BitDepth::One, None, &[0b1000_0000], 2),
        Pixels::Gray8(vec![255, 0])
    );
    assert_eq!(encode(ColorType::Rgba, BitDepth::Eight, None, &[1, 2, 3, 4], 1), Pixels::Rgb8(vec![1, 2, 3]));
    assert_eq!(encode(ColorType::GrayscaleAlpha, BitDepth::Eight, None, &[5, 4], 1), Pixels::Gray8(vec![5]));
    assert_eq!(
        encode(ColorType::Rgb, BitDepth::Sixteen, None, &[1, 0, 2, 0, 3, 0], 1),
        Pixels::Rgb8(vec![1, 2, 3])
    );
}

#[test]
fn compressed_depth_is_unpacked() {
    let stored = Image::try_new(2, 1, Pixels::Gray16(vec![0, 1010])).unwrap();
    let (a, b) = (2000.0_f32, 10.0_f32);
    let header = [&[0; 4][..], &a.to_le_bytes(), &b.to_le_bytes()].concat();
    let file = [header, encode_png(&stored).unwrap()].concat();
    let limits = Limits::default();
    assert_eq!(decode_compressed_depth("16UC1; compressedDepth", &file, &limits).unwrap(), stored);
    let float = decode_compressed_depth("32FC1; compressedDepth png", &file, &limits).unwrap();
    let Pixels::GrayF32(values) = float.into_pixels() else { panic!("floats") };
    assert!(values[0].is_nan() && (values[1] - 2.0).abs() < 1e-6);
    assert!(decode_compressed_depth("16UC1; compressedDepth rvl", &file[5..], &limits).is_err());
}

/// Splitmix64: damage that is the same on every run.
fn next(state: &mut u64) -> usize {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (*state ^ (*state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    usize::try_from((z ^ (z >> 31)) >> 33).unwrap()
}

#[test]
fn damaged_files_are_met() {
    let image = picture(24, 16);
    let files = [encode_jpeg(&image, 90).unwrap(), encode_png(&image).unwrap(), encode_tiff(&image).unwrap()];
    let limits = Limits { max_pixels: 10_000 };
    let mut state = 7;
    for file in files {
        for _ in 0..1500 {
            let mut bytes = file.clone();
            for _ in 0..1 + next(&mut state) % 4 {
                let at = next(&mut state) % bytes.len();
                bytes[at] = next(&mut state) as u8;
            }
            bytes.truncate(1 + next(&mut state) % bytes.len());
            verify(&bytes).ok();
            if let Ok(image) = decode(&bytes, &limits) {
                assert!(u64::from(image.width()) * u64::from(image.height()) <= limits.max_pixels);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 64,
        rng_seed: proptest::test_runner::RngSeed::Fixed(11),
        ..ProptestConfig::default()
    })]

    #[test]
    fn png_round_trip(width in 1_u32..40, height in 1_u32..40, seed in any::<u64>()) {
        let mut state = seed;
        let n = (width * height) as usize;
        let images = [
            Pixels::Rgb8((0..3 * n).map(|_| next(&mut state) as u8).collect()),
            Pixels::Gray8((0..n).map(|_| next(&mut state) as u8).collect()),
            Pixels::Gray16((0..n).map(|_| next(&mut state) as u16).collect()),
        ];
        for pixels in images {
            let image = Image::try_new(width, height, pixels).unwrap();
            prop_assert_eq!(decode(&encode_png(&image).unwrap(), &Limits::default()).unwrap(), image.clone());
            prop_assert_eq!(decode(&encode_tiff(&image).unwrap(), &Limits::default()).unwrap(), image);
        }
    }

    #[test]
    fn raw_of_any_size_is_met(
        layout in prop::sample::select(vec!["rgb8", "bgra8", "mono8", "16UC1", "32FC1", "yuyv", "nv12", "rgb16"]),
        width in 0_u32..20, height in 0_u32..20, step in 0_u32..100, n in 0_usize..3000,
    ) {
        let data = vec![1; n];
        if let Ok(image) = decode_raw(&raw(layout, width, height, step, &data), &Limits::default()) {
            prop_assert_eq!((image.width(), image.height()), (width, height));
        }
    }
}
