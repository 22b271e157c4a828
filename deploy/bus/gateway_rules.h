/* CRC-8 SAE J1850 over the data, its CRC byte taken as zero, then the data id, low byte first. */
static inline uint8_t brokk_crc8(const uint8_t *data, uint8_t length, uint8_t crc_byte, uint16_t data_id) {
  uint8_t crc = BROKK_CRC_START, i;
  for (i = 0; i < length; i++) crc = brokk_crc8_table[crc ^ (i == crc_byte ? 0u : data[i])];
  crc = brokk_crc8_table[crc ^ (data_id & 0xFFu)];
  return (uint8_t)(brokk_crc8_table[crc ^ (data_id >> 8)] ^ BROKK_CRC_FINAL);
}

/* Receiver's side of one message. Begin with all zero, then set modulus, period_ms, and wrap_ms: the
   ms after which its stamp wraps, 0 where it has none. */
typedef struct {
  uint16_t modulus, period_ms;
  uint32_t wrap_ms;
  uint8_t trust, heard, stamped, counter, good;
  uint32_t heard_ms, stamp_ms, debt;
  uint64_t errors, repeated;
} brokk_channel;

static inline uint8_t brokk_count_bits(uint64_t word) {
  uint8_t count = 0;
  for (; word; word &= word - 1u) count++;
  return count;
}

/* Count a message, good or not; returns the fault. Call it for a wrong length or CRC, and for a
   message that is too old: older than BROKK_ROUND_TRIP_MS (commands) or BROKK_REMOTE_MS (remote). */
static inline uint8_t brokk_count(brokk_channel *c, uint8_t fault) {
  uint8_t is_repeated = fault == BROKK_FAULT_REPEATED, is_wrong = fault && !is_repeated;
  c->errors = (c->errors << 1 | is_wrong) & BROKK_WINDOW_MASK;
  c->repeated = (c->repeated << 1 | is_repeated) & BROKK_WINDOW_MASK;
  if (!fault) {
    if (c->good < 255u) c->good++;
    if (c->good >= (c->trust == BROKK_TRUST_INIT ? BROKK_MIN_GOOD_INIT : BROKK_MIN_GOOD)) c->trust = BROKK_TRUST_VALID;
    return fault;
  }
  c->good = 0;
  if (brokk_count_bits(c->errors) > BROKK_MAX_ERRORS || brokk_count_bits(c->repeated) > BROKK_MAX_REPEATED ||
      fault == BROKK_FAULT_RATE) {
    c->trust = BROKK_TRUST_INVALID;
    c->errors = c->repeated = 0;
    c->stamped = 0;
  }
  return fault;
}

/* Check a message whose CRC is right; 0: use it, if trust is BROKK_TRUST_VALID. */
static inline uint8_t brokk_take(brokk_channel *c, uint8_t counter, uint32_t stamp_ms, uint32_t now_ms) {
  uint32_t elapsed_ms = now_ms - c->heard_ms, step;
  uint64_t paid = (uint64_t)elapsed_ms * BROKK_RATE_SLACK;
  uint8_t before = c->counter, first = !c->heard;
  c->heard_ms = now_ms;
  c->heard = 1;
  if (c->debt > BROKK_BURST) c->debt = BROKK_BURST;
  c->debt = (first || paid > c->debt ? 0u : (uint32_t)(c->debt - paid)) + 10u * c->period_ms;
  if (c->debt > BROKK_BURST) return brokk_count(c, BROKK_FAULT_RATE);
  if (c->stamped && elapsed_ms < c->wrap_ms / 2u &&
      (stamp_ms + c->wrap_ms - c->stamp_ms) % c->wrap_ms > c->wrap_ms / 2u)
    return brokk_count(c, BROKK_FAULT_LATE);
  c->stamp_ms = stamp_ms;
  c->stamped = 1;
  c->counter = counter;
  if (first) return brokk_count(c, 0u);
  step = (uint32_t)(counter + c->modulus - before) % c->modulus;
  if (step == 0u) return brokk_count(c, BROKK_FAULT_REPEATED);
  return brokk_count(c, step > BROKK_COUNTER_MAX_STEP ? BROKK_FAULT_SEQUENCE : 0u);
}
