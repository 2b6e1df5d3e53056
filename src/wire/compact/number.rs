//! Written forms of numbers.

use minicbor::decode::{self, Decoder};
use minicbor::encode::{self, Encoder, Write};

use super::Form;

/// A position in metres, written in whole millimetres.
pub(crate) struct Millimetres;

/// A number with 11 significant bits (0.05 %), such as a confidence, speed or size.
pub(crate) struct Half;

/// A number with 24 significant bits, such as the direction of a camera.
pub(crate) struct Single;

/// A covariance `[xx, xy, yy]` with 11 significant bits. Variances are rounded up and the
/// covariance towards zero, so that the certainty does not increase and the matrix stays positive
/// semi-definite.
pub(crate) struct CovarianceForm;

/// Largest number of millimetres that is written as an integer; all positions are below.
const MAX_MILLIMETRES: f64 = (1u64 << 53) as f64;

/// The major type of floats, in the upper three bits of a number's first byte.
const MAJOR_FLOAT: u8 = 7;

/// Magnitudes of normal half-precision numbers.
const HALF: std::ops::RangeInclusive<f64> = 6.103_515_625e-5..=65_504.0;

/// Magnitudes of normal single-precision numbers.
const SINGLE: std::ops::RangeInclusive<f64> = f32::MIN_POSITIVE as f64..=f32::MAX as f64;

/// Bits of a double's fraction in excess of the bits of a half and of a single.
const BEYOND_HALF: u64 = (1 << 42) - 1;
const BEYOND_SINGLE: u64 = (1 << 29) - 1;

impl Form<f64> for Millimetres {
    fn encode<C, W: Write>(
        metres: &f64,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        let millimetres = (metres * 1000.0).round();
        if millimetres.abs() <= MAX_MILLIMETRES {
            e.i64(millimetres as i64)?.ok()
        } else {
            e.f64(millimetres)?.ok()
        }
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<f64, decode::Error> {
        read(d).map(|millimetres| millimetres / 1000.0)
    }
}

impl Form<f64> for Half {
    fn encode<C, W: Write>(
        value: &f64,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        write_half(*value, Rounding::Nearest, e)
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<f64, decode::Error> {
        read(d)
    }
}

impl Form<f64> for Single {
    fn encode<C, W: Write>(
        value: &f64,
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        write_single(*value, Rounding::Nearest, e)
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<f64, decode::Error> {
        read(d)
    }
}

impl Form<[f64; 3]> for CovarianceForm {
    fn encode<C, W: Write>(
        [xx, xy, yy]: &[f64; 3],
        e: &mut Encoder<W>,
        _: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.array(3)?;
        write_half(*xx, Rounding::AwayFromZero, e)?;
        write_half(*xy, Rounding::TowardsZero, e)?;
        write_half(*yy, Rounding::AwayFromZero, e)
    }

    fn decode<C>(d: &mut Decoder<'_>, _: &mut C) -> Result<[f64; 3], decode::Error> {
        read_array(d, read)
    }
}

impl<F: Form<f64>> Form<[f64; 2]> for F {
    fn encode<C, W: Write>(
        [x, y]: &[f64; 2],
        e: &mut Encoder<W>,
        context: &mut C,
    ) -> Result<(), encode::Error<W::Error>> {
        e.array(2)?;
        F::encode(x, e, context)?;
        F::encode(y, e, context)
    }

    fn decode<C>(d: &mut Decoder<'_>, context: &mut C) -> Result<[f64; 2], decode::Error> {
        read_array(d, |d| F::decode(d, context))
    }
}

#[derive(Clone, Copy)]
enum Rounding {
    Nearest,
    AwayFromZero,
    TowardsZero,
}

impl Rounding {
    /// Rounds to a fraction without the bits in `beyond`.
    fn apply(self, value: f64, beyond: u64) -> f64 {
        let carry = match self {
            Self::Nearest => beyond / 2 + 1,
            Self::AwayFromZero => beyond,
            Self::TowardsZero => 0,
        };
        // A carry out of the fraction correctly increments the exponent.
        f64::from_bits((value.to_bits() + carry) & !beyond)
    }
}

/// True if the number is an integer of a single byte.
fn is_short(value: f64) -> bool {
    value.fract() == 0.0 && (-24.0..24.0).contains(&value)
}

fn write_half<W: Write>(
    value: f64,
    rounding: Rounding,
    e: &mut Encoder<W>,
) -> Result<(), encode::Error<W::Error>> {
    if !value.is_finite() {
        return e.f64(value)?.ok();
    }
    let rounded = rounding.apply(value, BEYOND_HALF);
    match rounded.abs() {
        _ if is_short(rounded) => e.i8(rounded as i8)?.ok(),
        magnitude if HALF.contains(&magnitude) => e.f16(rounded as f32)?.ok(),
        _ => write_single(value, rounding, e),
    }
}

fn write_single<W: Write>(
    value: f64,
    rounding: Rounding,
    e: &mut Encoder<W>,
) -> Result<(), encode::Error<W::Error>> {
    if !value.is_finite() {
        return e.f64(value)?.ok();
    }
    let rounded = rounding.apply(value, BEYOND_SINGLE);
    match rounded.abs() {
        _ if is_short(rounded) => e.i8(rounded as i8)?.ok(),
        magnitude if SINGLE.contains(&magnitude) => e.f32(rounded as f32)?.ok(),
        _ => e.f64(value)?.ok(),
    }
}

/// Reads an integer or a float of any width.
fn read(d: &mut Decoder<'_>) -> Result<f64, decode::Error> {
    let first = d.input().get(d.position());
    if first.is_some_and(|first| first >> 5 == MAJOR_FLOAT) {
        d.f64()
    } else {
        d.i64().map(|integer| integer as f64)
    }
}

fn read_array<const N: usize>(
    d: &mut Decoder<'_>,
    mut read: impl FnMut(&mut Decoder<'_>) -> Result<f64, decode::Error>,
) -> Result<[f64; N], decode::Error> {
    if d.array()? != Some(N as u64) {
        return Err(decode::Error::message("not as many numbers as expected"));
    }
    let mut values = [0.0; N];
    for value in &mut values {
        *value = read(d)?;
    }
    Ok(values)
}
