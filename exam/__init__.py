"""The blind exam of a diagnosis: cases whose cause is sealed, answers by processes that cannot read it, marks for every claim.

mix         which cases there are: kinds, effects, joints, sizes, drawn from a seed      mix.py
specimen    what a family of plants is asked for, and the family as a protocol           specimen.py
making      a plan, the recordings of reference and field, files                         making.py
seal        labels, their hash, and opening them                                         seal.py
sitting     each case to a process of its own, which sees its folder and nothing else    sitting.py
marking     one answer against one label                                                 marking.py
tally       marks to rates with intervals, calibration, confusion                        tally.py
page        table and pictures                                                           page.py
ledger      every scoring run, appended                                                  ledger.py
"""
