"""Blind exam of a diagnosis: sealed cases, answers without a way to the labels, metrics.

case_distribution  kinds, effects, joints, sizes of cases
generate           plans and recordings of cases, on disk
dataset            labels, and the sealed file of them
run_cases          one process a case
examiner           the repair of an answer, simulated on withheld recordings
score              one answer against one label
answer_scoring     answers of a candidate, their scores, published answers
ledger             who answered with which engine, and when labels were opened
metrics            rates with intervals, calibration, confusion
report             one page with the table
constant_answer    a candidate to compare with
"""
