// @ts-check
// Files that a tab of the browser keeps over a reload, in the browser's database; other tabs have their own.

/** @typedef {{at: number, name: string, content: ArrayBuffer}} Kept */

const NAME = "mauvecl", STORE = "files"
//: Days after which files of closed tabs are deleted.
const DAYS = 7

/** @template T
 * @param {IDBRequest<T>} request
 * @returns {Promise<T>} */
const result = request => new Promise((resolve, reject) => {
  request.onsuccess = () => resolve(request.result)
  request.onerror = () => reject(request.error)
})

/** Use the store of files.
 * @template T
 * @param {IDBTransactionMode} mode
 * @param {(store: IDBObjectStore) => IDBRequest<T>} use */
async function withStore(mode, use) {
  const opening = indexedDB.open(NAME, 1)
  opening.onupgradeneeded = () => opening.result.createObjectStore(STORE)
  const database = await result(opening)
  try {
    return await result(use(database.transaction(STORE, mode).objectStore(STORE)))
  } finally {
    database.close()
  }
}

// Keys of this tab's files by field: a tab keeps them over a reload, and no other tab changes a file behind a key.
const keys = () => /** @type {Record<string, number>} */ (JSON.parse(sessionStorage.getItem(NAME) ?? "{}"))

/** Keep a field's file; a browser that keeps nothing, as in some private windows, keeps none.
 * @param {string} field
 * @param {Kept} file */
export async function keep(field, file) {
  const key = file.at + Math.random()
  try {
    await withStore("readwrite", store => store.put(file, key))
    sessionStorage.setItem(NAME, JSON.stringify({...keys(), [field]: key}))
  } catch (why) {
    if (!(why instanceof DOMException)) throw why
  }
}

/** The files that this tab has kept, by field; old ones of other tabs are deleted.
 * @returns {Promise<Record<string, Kept>>} */
export async function kept() {
  /** @type {Record<string, Kept>} */
  const found = {}
  try {
    await withStore("readwrite", store => store.delete(IDBKeyRange.upperBound(Date.now() - DAYS * 86_400_000)))
    for (const [field, key] of Object.entries(keys())) {
      const file = await withStore("readonly", store => store.get(key))
      if (file) found[field] = file
    }
  } catch (why) {
    if (!(why instanceof DOMException)) throw why
  }
  return found
}
