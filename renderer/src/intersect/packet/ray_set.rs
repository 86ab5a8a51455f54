//! Sets of rays that go together.

/// Some of the rays of packets that go together.
#[derive(Clone, Copy)]
pub(crate) struct RaySet<const N: usize> {
    /// A bit for each ray of each packet.
    pub(crate) masks: [u64; N],
}

impl<const N: usize> RaySet<N> {
    /// None of them.
    pub(crate) const NONE: Self = Self { masks: [0; N] };

    /// How many.
    #[inline(always)]
    pub(crate) fn count(&self) -> u32 {
        let mut count = 0;
        for packet in 0..N {
            count += self.masks[packet].count_ones();
        }
        count
    }

    /// Whether there are none.
    #[inline(always)]
    pub(crate) fn is_empty(&self) -> bool {
        let mut any = 0;
        for packet in 0..N {
            any |= self.masks[packet];
        }
        any == 0
    }

    /// Those that are in both.
    #[inline(always)]
    pub(crate) fn and(mut self, other: &Self) -> Self {
        for packet in 0..N {
            self.masks[packet] &= other.masks[packet];
        }
        self
    }
}
