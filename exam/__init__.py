"""Blind exam of a diagnosis: sealed cases, answers without a way to the labels, metrics.

case_distribution  kinds, effects, joints, sizes of cases
generate           plans and recordings of cases, on disk
dataset            labels, the sealed file of them, and the ledger of who answered and when labels were opened
run_cases          candidates, one process a case; their answers, published ones too
examiner           the repair of an answer, simulated on withheld recordings
score              one answer against one label
metrics            rates with intervals over all answers; one page with the table
"""
