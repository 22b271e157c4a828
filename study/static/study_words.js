// All that the study's pages say, in English and German. The questions are those of NASA-TLX (Hart and Staveland 1988, paper form).
const EN = {
  locked: "Open this page by the link with the key", choose: "Who takes part now?", consent: "Your consent", agree: "I agree", decline: "I do not agree",
  "state new": "not begun", "state begun": "begun", "state done": "done", "state stopped": "stopped", "state erased": "erased",
  period: "Period", practice: "Practice", trial: "trial", guided: "With guidance", unguided: "Without guidance", hole: "Borehole", start: "start",
  "task guided": "Bring the chisel into the borehole as fast as you safely can. Follow the green marks with your levers.",
  "task unguided": "Bring the chisel into the borehole as fast as you safely can. No advice is shown.",
  drive: "First the arm goes to its start. Every joint has a tick when it is there.", begin: "Begin", "end practice": "Enough practice", next: "Next", back: "Back", skip: "Leave open",
  "not there": "The arm is not at its start yet", "no positions": "Nothing is known of the arm", "no advice": "No advice yet", starting: "Recording begins …", saving: "Saving …",
  "end trial": "End trial", fault: "Fault: do it again", again: "It is kept, does not count, and is done again",
  "outcome inserted": "Inserted", "outcome time limit": "Time is over", "outcome stopped": "Trial ended", "outcome aborted": "Trial aborted",
  missing: "questions are open", complete: "All questions are answered", "to missing": "To the first open one",
  finish: "Finish", "finish half": "Finish as it is", done: "That was everything", thanks: "Thank you for taking part.", list: "List of participants",
  stopped: "You have stopped taking part", kept: "What was done until now is kept, unless you ask for it to be erased.", "go on": "Go on after all",
  "stop taking part": "Stop taking part", "really stop": "Really stop? Press again",
  "refused failed": "It could not be done", "refused no positions": "Nothing is known of the arm", "refused not now": "Not now", "refused malformed": "Not understood", "refused nobody": "Nobody was chosen",
};
const DE = {
  locked: "Diese Seite über den Link mit Schlüssel öffnen", choose: "Wer nimmt jetzt teil?", consent: "Ihre Einwilligung", agree: "Ich willige ein", decline: "Ich willige nicht ein",
  "state new": "nicht begonnen", "state begun": "begonnen", "state done": "fertig", "state stopped": "beendet", "state erased": "gelöscht",
  period: "Abschnitt", practice: "Übung", trial: "Versuch", guided: "Mit Führung", unguided: "Ohne Führung", hole: "Bohrloch", start: "Start",
  "task guided": "Bringen Sie den Meißel so schnell, wie es sicher geht, in das Bohrloch. Folgen Sie mit den Hebeln den grünen Zeichen.",
  "task unguided": "Bringen Sie den Meißel so schnell, wie es sicher geht, in das Bohrloch. Es wird kein Vorschlag gezeigt.",
  drive: "Zuerst fährt der Arm an seinen Start. Jedes Gelenk hat einen Haken, wenn es dort ist.", begin: "Beginnen", "end practice": "Genug geübt", next: "Weiter", back: "Zurück", skip: "Offen lassen",
  "not there": "Der Arm ist noch nicht an seinem Start", "no positions": "Vom Arm ist nichts bekannt", "no advice": "Noch kein Vorschlag", starting: "Aufnahme beginnt …", saving: "Wird gespeichert …",
  "end trial": "Versuch beenden", fault: "Störung: wiederholen", again: "Er wird behalten, zählt nicht und wird wiederholt",
  "outcome inserted": "Eingeführt", "outcome time limit": "Die Zeit ist um", "outcome stopped": "Versuch beendet", "outcome aborted": "Versuch abgebrochen",
  missing: "Fragen sind offen", complete: "Alle Fragen sind beantwortet", "to missing": "Zur ersten offenen",
  finish: "Fertig", "finish half": "So abschließen", done: "Das war alles", thanks: "Danke für Ihre Teilnahme.", list: "Liste der Teilnehmenden",
  stopped: "Sie haben die Teilnahme beendet", kept: "Was bis jetzt getan wurde, wird behalten, wenn Sie nicht um Löschung bitten.", "go on": "Doch weitermachen",
  "stop taking part": "Teilnahme beenden", "really stop": "Wirklich beenden? Noch einmal drücken",
  "refused failed": "Das ging nicht", "refused no positions": "Vom Arm ist nichts bekannt", "refused not now": "Jetzt nicht", "refused malformed": "Nicht verstanden", "refused nobody": "Niemand ist gewählt",
};
// title, question, left end, right end; performance goes from good to poor, so that more is more load on all six
const SCALES_EN = {
  mental: ["Mental demand", "How mentally demanding was the task?", "Very low", "Very high"],
  physical: ["Physical demand", "How physically demanding was the task?", "Very low", "Very high"],
  temporal: ["Temporal demand", "How hurried or rushed was the pace of the task?", "Very low", "Very high"],
  performance: ["Performance", "How successful were you in accomplishing what you were asked to do?", "Perfect", "Failure"],
  effort: ["Effort", "How hard did you have to work to accomplish your level of performance?", "Very low", "Very high"],
  frustration: ["Frustration", "How insecure, discouraged, irritated, stressed and annoyed were you?", "Very low", "Very high"],
};
const SCALES_DE = {
  mental: ["Geistige Anforderung", "Wie hoch waren die geistigen Anforderungen der Aufgabe?", "Sehr gering", "Sehr hoch"],
  physical: ["Körperliche Anforderung", "Wie hoch waren die körperlichen Anforderungen der Aufgabe?", "Sehr gering", "Sehr hoch"],
  temporal: ["Zeitliche Anforderung", "Wie hoch war das Tempo, mit dem die Aufgabe zu erledigen war?", "Sehr gering", "Sehr hoch"],
  performance: ["Leistung", "Wie erfolgreich haben Sie die Aufgabe Ihrer Ansicht nach ausgeführt?", "Perfekt", "Misserfolg"],
  effort: ["Anstrengung", "Wie sehr mussten Sie sich anstrengen, um Ihre Leistung zu erreichen?", "Sehr gering", "Sehr hoch"],
  frustration: ["Frustration", "Wie verunsichert, entmutigt, gereizt, gestresst und verärgert waren Sie?", "Sehr gering", "Sehr hoch"],
};

export const words = language => key => (language === "de" ? DE : EN)[key] ?? key;
export const scales = language => language === "de" ? SCALES_DE : SCALES_EN;
